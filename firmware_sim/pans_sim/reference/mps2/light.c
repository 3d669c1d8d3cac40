/* Projector and detector of a board that stands before no light: p = 1 - exp(-mean), PEAK_HZ photoelectrons a second of a lit, clear pixel
 * and DARK_HZ dark counts, as in the profile dmd-spad. The sum of an image over a mask is looked up by half bytes. scene.h holds the images: see
 * tests/instruments/qemu_link.py. */
#include <string.h>

#include "board.h"
#include "scene.h"

enum { PATTERNS = 4096, MASK_BYTES = (PIXELS + 7) / 8, PEAK_HZ = 2000, DARK_HZ = 100 };

__attribute__((section(".bench"))) static uint8_t mask[PATTERNS][MASK_BYTES];
__attribute__((section(".bench"))) static uint16_t sums[OBJECTS][2 * MASK_BYTES][16];

void light_init(void)
{
    for (uint32_t o = 0; o < OBJECTS; o++)
        for (uint32_t half = 0; half < PIXELS / 4; half++)
            for (uint32_t bits = 0; bits < 16; bits++) {
                uint32_t sum = 0;
                for (uint32_t i = 0; i < 4; i++)
                    sum += (bits >> i & 1u) * IMAGE[o][4 * half + i];
                sums[o][half][bits] = (uint16_t)sum;
            }
}

void light_store(const struct pans_pixels *p)
{
    if (p == NULL) {
        memset(mask, 0, sizeof mask);
        return;
    }
    for (uint32_t i = 0; i < p->count && p->pattern < PATTERNS && p->first + i < PIXELS; i++) {
        uint32_t at = p->first + i, on = p->bits ? p->data[i / 8] >> i % 8 & 1u : p->data[2 * i] != 0;
        uint8_t *byte = mask[p->pattern] + at / 8;
        *byte = (uint8_t)((*byte & ~(1u << at % 8)) | on << at % 8);
    }
}

/* Steele, Lea and Flood's finaliser over a counter: the same run gives the same clicks. */
static uint32_t chance(void)
{
    static uint64_t count;
    uint64_t word = ++count * 0x9E3779B97F4A7C15u;
    word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9u;
    word = (word ^ word >> 27) * 0x94D049BB133111EBu;
    return (uint32_t)(word >> 32);
}

bool light_click(const struct pans_exposure *e)
{
    uint32_t sum = 0;
    for (uint32_t i = 0; e->light.pattern < PATTERNS && i < MASK_BYTES; i++) {
        const uint16_t(*table)[16] = sums[e->object % OBJECTS] + 2 * i;
        uint8_t bits = mask[e->light.pattern][i];
        sum += (uint32_t)table[0][bits & 15] + table[1][bits >> 4];
    }
    /* the mean in units of 2^-20; CLICK is 2^32 (1 - exp(-k / 64)), between whose entries the line is straight enough */
    uint64_t lit = (uint64_t)sum * e->light.ticks / 255u, dark = (uint64_t)DARK_HZ * e->ticks;
    uint64_t mean = ((lit * PEAK_HZ + dark) << 20) / TICK_HZ;
    uint32_t at = (uint32_t)(mean >> 14), part = (uint32_t)(mean & 16383u);
    if (at >= sizeof CLICK / sizeof CLICK[0] - 1)
        return true;
    return chance() < CLICK[at] + (uint32_t)((uint64_t)(CLICK[at + 1] - CLICK[at]) * part >> 14);
}

int16_t light_class(uint32_t object)
{
    return CLASS[object % OBJECTS];
}

uint32_t light_objects(void)
{
    return OBJECTS;
}
