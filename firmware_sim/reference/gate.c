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

static bool is_open(const struct gates *g, uint16_t output)
{
    for (uint16_t i = 0; i < g->count; i++)
        if (g->at[i].open && g->at[i].output == output)
            return true;
    return false;
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
    if (d->gates.count == d->limits.gate_pulses)
        return refuse_number(d, PANS_RANGE, "number of pending gates", d->gates.count + 1u, d->limits.gate_pulses);
    d->gates.at[d->gates.count++] = (struct pulse){tick, tick + ticks, output, false};
    find_next(&d->gates);
    return PANS_DONE;
}

/* Open and close what is due at the present tick. */
void gates_do_due(struct pans_device *d)
{
    struct gates *g = &d->gates;
    for (uint16_t i = 0; i < g->count;) {
        struct pulse *pulse = g->at + i;
        if (!pulse->open && pulse->tick <= d->tick) {
            bool was_open = is_open(g, pulse->output);
            pulse->open = true;
            if (!was_open)
                d->hw.gate(d->hw.self, pulse->output, true);
        }
        if (!pulse->open || pulse->end > d->tick) {
            i++;
            continue;
        }
        uint16_t output = pulse->output;
        *pulse = g->at[--g->count];
        if (!is_open(g, output))
            d->hw.gate(d->hw.self, output, false);
    }
    find_next(g);
}

void gates_close(struct pans_device *d)
{
    struct gates *g = &d->gates;
    while (g->count != 0) {
        struct pulse last = g->at[--g->count];
        if (last.open && !is_open(g, last.output))
            d->hw.gate(d->hw.self, last.output, false);
    }
    find_next(g);
}
