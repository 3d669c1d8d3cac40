/* LOAD_PLAN: the schedule, checked as a whole when its last slot has come. */
#include "internal.h"

#define SLOT_BYTES 12u
#define MAX_SLOTS_HERE 1024u

/* The protocol's table: u8 mode, u8, u16 patterns, u32 slots, u32 first slot, u32 exposure, u32 spacing, u64 cycle, u16 block, u16, u32
 * cycles per object: 36 bytes. */
struct head {
    struct plan plan;
    uint32_t first_slot, slots_here;
    const uint8_t *slots;
};

uint16_t word_bytes(uint16_t channels)
{
    uint16_t bytes = (uint16_t)((channels + 7) / 8);
    if (bytes <= 2)
        return bytes;
    return bytes <= 4 ? 4 : (uint16_t)((bytes + 7) / 8 * 8);
}

uint64_t gap_after(const struct plan *plan, uint32_t slot)
{
    if (slot + 1 < plan->n_slots)
        return plan->start[slot + 1] - plan->start[slot];
    return plan->start[0] + plan->cycle_ticks - plan->start[slot];
}

static uint32_t block_payload(const struct plan *plan)
{
    uint32_t n = plan->block_exposures;
    return BLOCK_HEADER + (plan->mode == 1 ? n * word_bytes(plan->n_patterns) : 2 * n + (n + 7) / 8);
}

static enum pans_status check_head(struct pans_device *d, const struct plan *p)
{
    const struct pans_limits *l = &d->limits;
    uint32_t most = l->parallel ? l->channels : l->pattern_memory;
    if (p->mode != (l->parallel ? 1 : 0))
        return refuse_number(d, PANS_RANGE, "mode", p->mode, l->parallel ? 1 : 0);
    if (p->n_patterns == 0 || p->n_patterns > most)
        return refuse_number(d, PANS_RANGE, "number of patterns", p->n_patterns, most);
    if (p->n_slots == 0 || p->n_slots > l->slot_memory)
        return refuse_number(d, PANS_RANGE, "number of slots", p->n_slots, l->slot_memory);
    if (p->exposure_ticks < l->exposure_min_ticks || p->exposure_ticks == 0)
        return refuse_number(d, PANS_RANGE, "exposure in ticks", p->exposure_ticks, l->exposure_min_ticks);
    if (p->exposure_ticks > l->exposure_max_ticks)
        return refuse_number(d, PANS_RANGE, "exposure in ticks", p->exposure_ticks, l->exposure_max_ticks);
    if (p->period_ticks == 0)
        return refuse(d, PANS_RANGE, "exposures 0 ticks apart");
    if (p->cycle_ticks == 0 || p->cycle_ticks > MAX_CYCLE_TICKS)
        return refuse_number(d, PANS_RANGE, "cycle in ticks", p->cycle_ticks, MAX_CYCLE_TICKS);
    if (p->cycles_per_object == 0)
        return refuse(d, PANS_RANGE, "0 cycles per object");
    if (p->block_exposures == 0 || block_payload(p) > l->block_bytes)
        return refuse_number(d, PANS_RANGE, "block in bytes", block_payload(p), l->block_bytes);
    return PANS_DONE;
}

static enum pans_status check_slots(struct pans_device *d, const struct head *head)
{
    bool automata = d->limits.dwell_steps != 0;
    for (uint32_t i = 0; i < head->slots_here; i++) {
        const uint8_t *slot = head->slots + SLOT_BYTES * i;
        uint16_t pattern = get16(slot + 8), shot = get16(slot + 10);
        if (get64(slot) >= head->plan.cycle_ticks)
            return refuse_number(d, PANS_RANGE, "start of an exposure", get64(slot), head->plan.cycle_ticks - 1);
        if (pattern == PANS_DARK || (pattern == PANS_ADAPTIVE && automata)) {
            if (pattern == PANS_DARK && shot != 0xFFFF)
                return refuse_number(d, PANS_RANGE, "shot of a dark slot", shot, 0xFFFF);
            continue;
        }
        if (pattern >= head->plan.n_patterns)
            return refuse_number(d, PANS_RANGE, "pattern of a slot", pattern, head->plan.n_patterns - 1u);
        if (shot == 0xFFFF)
            return refuse(d, PANS_RANGE, "a lit slot without a shot");
    }
    return PANS_DONE;
}

static bool same_head(const struct plan *a, const struct plan *b)
{
    return a->mode == b->mode && a->n_patterns == b->n_patterns && a->n_slots == b->n_slots && a->exposure_ticks == b->exposure_ticks &&
           a->period_ticks == b->period_ticks && a->cycle_ticks == b->cycle_ticks && a->block_exposures == b->block_exposures &&
           a->cycles_per_object == b->cycles_per_object;
}

/* Exposures closer than the detector can be read, or out of order. */
static enum pans_status check_spacing(struct pans_device *d)
{
    const struct plan *p = &d->plan;
    uint64_t needed = (uint64_t)p->exposure_ticks + d->limits.readout_ticks;
    for (uint32_t i = 0; i < p->n_slots; i++) {
        bool backwards = i + 1 < p->n_slots && p->start[i + 1] <= p->start[i];
        uint64_t gap = backwards ? 0 : gap_after(p, i);
        if (gap < needed)
            return refuse_number(d, PANS_RANGE, "least ticks between two exposures", gap, needed);
    }
    return PANS_DONE;
}

/* Patterns that follow each other faster than the projector can change them. */
static enum pans_status check_changes(struct pans_device *d)
{
    const struct plan *p = &d->plan;
    uint64_t first = PANS_NEVER, last = 0;
    uint16_t before = p->pattern[p->n_slots - 1];
    for (uint32_t i = 0; i < p->n_slots; i++) {
        bool changes = p->pattern[i] != before || (p->adaptive && p->pattern[i] == PANS_ADAPTIVE);
        before = p->pattern[i];
        if (!changes)
            continue;
        if (first == PANS_NEVER)
            first = p->start[i];
        else if (p->start[i] - last < d->limits.pattern_ticks)
            return refuse_number(d, PANS_RANGE, "least ticks between two patterns", p->start[i] - last, d->limits.pattern_ticks);
        last = p->start[i];
    }
    if (first != PANS_NEVER && first + p->cycle_ticks - last < d->limits.pattern_ticks)
        return refuse_number(d, PANS_RANGE, "least ticks between two patterns", first + p->cycle_ticks - last, d->limits.pattern_ticks);
    return PANS_DONE;
}

static enum pans_status complete(struct pans_device *d)
{
    struct plan *p = &d->plan;
    uint32_t fixed = 0, adaptive = 0;
    for (uint32_t i = 0; i < p->n_slots; i++) {
        adaptive += p->pattern[i] == PANS_ADAPTIVE && d->limits.dwell_steps != 0;
        fixed += p->pattern[i] < PANS_ADAPTIVE;
    }
    if (adaptive != 0 && fixed != 0)
        return refuse_number(d, PANS_RANGE, "number of fixed patterns beside adaptive slots", fixed, 0);
    p->adaptive = adaptive != 0;
    p->adaptive_slots = adaptive;
    enum pans_status status = check_spacing(d);
    if (status == PANS_DONE && p->mode == 0)
        status = check_changes(d);
    p->complete = status == PANS_DONE;
    return status;
}

static enum pans_status read_head(struct pans_device *d, const uint8_t *body, uint32_t count, struct head *head)
{
    if (count < 36 || (count - 36) % SLOT_BYTES != 0)
        return refuse(d, PANS_MALFORMED, "LOAD_PLAN: a header of 36 bytes, and slots of 12");
    struct plan *p = &head->plan;
    head->slots_here = (count - 36) / SLOT_BYTES;
    head->slots = body + 36;
    p->mode = body[0];
    p->n_patterns = get16(body + 2);
    p->n_slots = get32(body + 4);
    head->first_slot = get32(body + 8);
    p->exposure_ticks = get32(body + 12);
    p->period_ticks = get32(body + 16);
    p->cycle_ticks = get64(body + 20);
    p->block_exposures = get16(body + 28);
    p->cycles_per_object = get32(body + 32);
    if (head->slots_here == 0 || head->slots_here > MAX_SLOTS_HERE)
        return refuse_number(d, PANS_MALFORMED, "LOAD_PLAN: number of slots", head->slots_here, MAX_SLOTS_HERE);
    if (head->first_slot > p->n_slots || head->slots_here > p->n_slots - head->first_slot)
        return refuse_number(d, PANS_MALFORMED, "LOAD_PLAN: last slot", (uint64_t)head->first_slot + head->slots_here, p->n_slots);
    return PANS_DONE;
}

enum pans_status load_plan(struct pans_device *d, const uint8_t *body, uint32_t count)
{
    struct head head = {0};
    struct plan *p = &d->plan;
    enum pans_status status = read_head(d, body, count, &head);
    if (status == PANS_DONE && head.first_slot == 0)
        status = check_head(d, &head.plan);
    else if (status == PANS_DONE && (p->filled == 0 || head.first_slot != p->filled || !same_head(&head.plan, p)))
        status = refuse_number(d, PANS_RANGE, "first slot", head.first_slot, p->filled);
    if (status == PANS_DONE)
        status = check_slots(d, &head);
    if (status != PANS_DONE)
        return status;
    if (head.first_slot == 0) {
        head.plan.start = p->start;
        head.plan.pattern = p->pattern;
        *p = head.plan;
        forget_states(d);
    }
    for (uint32_t i = 0; i < head.slots_here; i++) {
        p->start[p->filled] = get64(head.slots + SLOT_BYTES * i);
        p->pattern[p->filled++] = get16(head.slots + SLOT_BYTES * i + 8);
    }
    if (p->filled < p->n_slots)
        return PANS_DONE;
    status = complete(d);
    if (status == PANS_DONE && require_patterns(d) == PANS_DONE)
        prepare(d); /* the hardware may take its time now; ARM says what is wrong */
    return status;
}
