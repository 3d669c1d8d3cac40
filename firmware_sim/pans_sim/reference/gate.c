/* Gates: pulses at absolute ticks. A pulse that comes too late is refused, never late. */
#include "internal.h"

static void find_next(struct gates *g)
{
    g->next_tick = PANS_NEVER;
    for (uint16_t i = 0; i < g->count; i++) {
        uint64_t due = g->at[i].open ? g->at[i].end : g->at[i].tick;
        g->next_tick = due < g->next_tick ? due : g->next_tick;
    }
}

/* Of pulses that overlap on one output the first opens it, the last closes it. */
static void switch_to(struct pans_device *d, const struct pulse *pulse, bool open, uint64_t tick)
{
    uint16_t *holders = d->gates.open + pulse->output, before = *holders;
    *holders = (uint16_t)(open ? before + 1 : before - 1);
    if (before == 0 || *holders == 0)
        d->hw.gate(d->hw.self, pulse->output, open, tick);
}

enum pans_status take_gate(struct pans_device *d, const uint8_t *body, uint32_t count)
{
    if (count != 16)
        return refuse_number(d, PANS_MALFORMED, "GATE: number of bytes", count, 16);
    uint64_t tick = get64(body);
    uint32_t ticks = get32(body + 8);
    uint16_t output = get16(body + 12);
    if (!d->run.active)
        return refuse(d, PANS_WRONG_STATE, "GATE needs a run");
    if (tick <= d->tick)
        return refuse_number(d, PANS_LATE, "gate tick, which has passed: it", tick, d->tick + 1);
    if (output >= d->limits.gate_outputs)
        return refuse_number(d, PANS_RANGE, "gate output", output, d->limits.gate_outputs - 1u);
    if (ticks == 0 || tick >= LAST_TICK)
        return refuse(d, PANS_RANGE, "a gate of 0 ticks, or beyond the last tick");
    hold(d, true);
    bool full = d->gates.count == d->limits.gate_pulses;
    if (!full)
        d->gates.at[d->gates.count++] = (struct pulse){tick, tick + ticks, output, false};
    find_next(&d->gates);
    hold(d, false);
    return full ? refuse_number(d, PANS_RANGE, "number of pending gates", d->limits.gate_pulses + 1u, d->limits.gate_pulses) : PANS_DONE;
}

void gates_switch(struct pans_device *d)
{
    struct gates *g = &d->gates;
    uint64_t tick = g->next_tick;
    for (uint16_t i = 0; i < g->count;) {
        struct pulse *pulse = g->at + i;
        if (!pulse->open && pulse->tick <= tick) {
            pulse->open = true;
            switch_to(d, pulse, true, tick);
        }
        if (!pulse->open || pulse->end > tick) {
            i++;
            continue;
        }
        switch_to(d, pulse, false, tick);
        *pulse = g->at[--g->count];
    }
    find_next(g);
}

void gates_close(struct pans_device *d)
{
    struct gates *g = &d->gates;
    hold(d, true);
    while (g->count != 0)
        if (g->at[--g->count].open)
            switch_to(d, g->at + g->count, false, d->tick);
    find_next(g);
    hold(d, false);
}
