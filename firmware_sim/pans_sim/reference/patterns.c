/* LOAD_PATTERN and LOAD_MASKS: what has come of each pattern; the pixels themselves go on to the projector. */
#include <string.h>

#include "internal.h"

#define MAX_LEVELS_HERE 4096u

void forget_patterns(struct pans_device *d)
{
    memset(d->patterns, 0, d->limits.pattern_memory * sizeof d->patterns[0]);
    d->held_pixels = 0;
    d->patterns_revision++;
    d->hw.store(d->hw.self, NULL);
}

/* Whether a piece (or, of several patterns, the whole of them) can be stored; nothing is changed. */
static enum pans_status check(struct pans_device *d, const struct pans_pixels *piece, uint32_t patterns)
{
    uint32_t last = piece->pattern + patterns - 1;
    if (last >= d->limits.pattern_memory)
        return refuse_number(d, PANS_RANGE, "pattern", last, d->limits.pattern_memory - 1u);
    if (piece->whole > d->limits.pattern_pixels)
        return refuse_number(d, PANS_RANGE, "size of a pattern in pixels", piece->whole, d->limits.pattern_pixels);
    const struct pattern *known = d->patterns + piece->pattern;
    if (piece->first != 0 && (piece->first != known->filled || piece->whole != known->whole))
        return refuse_number(d, PANS_RANGE, "first pixel", piece->first, known->filled);
    if (piece->first != 0)
        return PANS_DONE;
    uint64_t wanted = d->held_pixels + (uint64_t)patterns * piece->whole;
    for (uint32_t i = 0; i < patterns; i++)
        wanted -= known[i].whole; /* a pattern that is loaded anew gives its place back */
    if (wanted > d->limits.pixel_memory)
        return refuse_number(d, PANS_RANGE, "number of pixels of all patterns", wanted, d->limits.pixel_memory);
    return PANS_DONE;
}

static void store(struct pans_device *d, const struct pans_pixels *piece)
{
    struct pattern *pattern = d->patterns + piece->pattern;
    if (piece->first == 0) {
        d->held_pixels += (uint64_t)piece->whole - pattern->whole;
        *pattern = (struct pattern){piece->whole, 0};
    }
    pattern->filled += piece->count;
    d->patterns_revision++;
    d->hw.store(d->hw.self, piece);
}

enum pans_status load_pattern(struct pans_device *d, const uint8_t *body, uint32_t count)
{
    if (count < 14 || (count - 12) % 2 != 0 || (count - 12) / 2 > MAX_LEVELS_HERE)
        return refuse(d, PANS_MALFORMED, "LOAD_PATTERN: 1 to 4096 levels of 16 bits");
    uint32_t pixels = (count - 12) / 2, first = get32(body + 4), whole = get32(body + 8);
    if (first > whole || pixels > whole - first)
        return refuse_number(d, PANS_MALFORMED, "LOAD_PATTERN: last pixel", (uint64_t)first + pixels, whole);
    for (uint32_t i = 0; i < pixels; i++) {
        uint16_t level = get16(body + 12 + 2 * i);
        if (level >= d->limits.levels)
            return refuse_number(d, PANS_RANGE, "level", level, d->limits.levels - 1);
    }
    struct pans_pixels piece = {get16(body), first, pixels, whole, false, body + 12};
    enum pans_status status = check(d, &piece, 1);
    if (status == PANS_DONE)
        store(d, &piece);
    return status;
}

enum pans_status load_masks(struct pans_device *d, const uint8_t *body, uint32_t count)
{
    if (count < 16)
        return refuse(d, PANS_MALFORMED, "LOAD_MASKS: a header of 16 bytes");
    uint32_t masks = get16(body + 2), first = get32(body + 4), whole = get32(body + 8), pixels = get32(body + 12);
    uint64_t row = ((uint64_t)pixels + 7) / 8;
    if (masks == 0 || pixels == 0 || count - 16 != masks * row || first > whole || pixels > whole - first)
        return refuse_number(d, PANS_MALFORMED, "LOAD_MASKS: bytes of pixels", count - 16, masks * row);
    if (masks > 1 && (first != 0 || pixels != whole))
        return refuse(d, PANS_MALFORMED, "LOAD_MASKS: pieces of several patterns");
    struct pans_pixels piece = {get16(body), first, pixels, whole, true, body + 16};
    enum pans_status status = check(d, &piece, masks);
    for (uint32_t i = 0; status == PANS_DONE && i < masks; i++) {
        store(d, &piece);
        piece.pattern++;
        piece.data += row;
    }
    return status;
}

enum pans_status require_patterns(struct pans_device *d)
{
    for (uint32_t i = 0; i < d->plan.n_patterns; i++) {
        if (d->patterns[i].whole == 0 || d->patterns[i].filled != d->patterns[i].whole)
            return refuse_number(d, PANS_WRONG_STATE, "number of the first pattern that is not loaded", i, d->plan.n_patterns);
        if (d->patterns[i].whole != d->patterns[0].whole)
            return refuse_number(d, PANS_RANGE, "size of a pattern in pixels", d->patterns[i].whole, d->patterns[0].whole);
    }
    return PANS_DONE;
}
