/* The epoch, in the last two sectors of the flash: a list of words each, of which every start appends one. A full list is followed by the other
 * sector, which is erased before; so the highest number is never without a place, also when the power fails. 100 000 erasures of each are 2 x 10^8
 * starts. */
#include "board.h"
#include "hardware/flash.h"
#include "hardware/sync.h"
#include "pico/platform.h"

enum { WORDS = FLASH_SECTOR_SIZE / 4, PAGE_WORDS = FLASH_PAGE_SIZE / 4 };
#define ERASED 0xFFFFFFFFu

static uint32_t place(uint32_t sector)
{
    return PICO_FLASH_SIZE_BYTES - (2 - sector) * FLASH_SECTOR_SIZE;
}

static const volatile uint32_t *words_of(uint32_t sector)
{
    return (const volatile uint32_t *)(XIP_BASE + place(sector));
}

static uint32_t used_of(uint32_t sector)
{
    uint32_t used = 0;
    while (used < WORDS && words_of(sector)[used] != ERASED)
        used++;
    return used;
}

uint32_t next_epoch(void)
{
    uint32_t used[2] = {used_of(0), used_of(1)}, last[2], page[PAGE_WORDS];
    for (uint32_t s = 0; s < 2; s++)
        last[s] = used[s] == 0 ? 0 : words_of(s)[used[s] - 1];
    uint32_t sector = last[1] > last[0], epoch = last[sector] + 1, at = used[sector];
    uint32_t interrupts = save_and_disable_interrupts();
    if (at == WORDS) {
        sector = 1 - sector;
        at = 0;
        flash_range_erase(place(sector), FLASH_SECTOR_SIZE);
    }
    for (uint32_t i = 0; i < PAGE_WORDS; i++)
        page[i] = i == at % PAGE_WORDS ? epoch : ERASED; /* programming clears bits only: the others stay as they are */
    flash_range_program(place(sector) + at / PAGE_WORDS * FLASH_PAGE_SIZE, (const uint8_t *)page, FLASH_PAGE_SIZE);
    restore_interrupts(interrupts);
    return epoch;
}
