/* The epoch, in the last two sectors of the flash: one record for each start. A sector is erased when the other one is full, so that the latest
 * record is never without a place, also when the power fails. 100 000 erasures of each are 10^8 starts. */
#include <string.h>

#include "board.h"
#include "hardware/flash.h"
#include "hardware/sync.h"
#include "pico/platform.h"

struct record {
    uint32_t epoch, inverse; /* of what was not programmed to its end they do not agree */
};

enum { RECORDS = 2 * FLASH_SECTOR_SIZE / sizeof(struct record) };
#define KEPT (PICO_FLASH_SIZE_BYTES - 2 * FLASH_SECTOR_SIZE)

static void keep(uint32_t place, struct record record)
{
    uint32_t at = KEPT + place * sizeof record, page = at / FLASH_PAGE_SIZE * FLASH_PAGE_SIZE;
    uint8_t bytes[FLASH_PAGE_SIZE];
    memset(bytes, 0xFF, sizeof bytes); /* programming clears bits only: the others stay as they are */
    memcpy(bytes + (at - page), &record, sizeof record);
    uint32_t interrupts = save_and_disable_interrupts();
    if (at % FLASH_SECTOR_SIZE == 0)
        flash_range_erase(at, FLASH_SECTOR_SIZE);
    flash_range_program(page, bytes, sizeof bytes);
    restore_interrupts(interrupts);
}

uint32_t next_epoch(void)
{
    const volatile struct record *kept = (const volatile struct record *)(XIP_BASE + KEPT);
    uint32_t latest = 0, place = 0;
    for (uint32_t i = 0; i < RECORDS; i++)
        if (kept[i].epoch == ~kept[i].inverse && kept[i].epoch > latest) {
            latest = kept[i].epoch;
            place = (i + 1) % RECORDS;
        }
    while (place * sizeof *kept % FLASH_SECTOR_SIZE != 0 && (kept[place].epoch & kept[place].inverse) != UINT32_MAX)
        place = (place + 1) % RECORDS;
    keep(place, (struct record){latest + 1, ~(latest + 1)});
    return kept[place].epoch == latest + 1 && kept[place].inverse == ~(latest + 1) ? latest + 1 : 0;
}
