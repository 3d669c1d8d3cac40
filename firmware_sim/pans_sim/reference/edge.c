/* What happens at a tick: exposures begin and end, gates switch. No framing, no division, no loop over more than the names and pulses that
 * are pending: what is left to do waits in a ring for the main loop. */
#include <string.h>

#include "internal.h"

void hold(struct pans_device *d, bool on)
{
    if (d->hw.hold != NULL)
        d->hw.hold(d->hw.self, on);
}

void place_next(const struct plan *plan, struct place *place)
{
    place->number++;
    if (++place->slot < plan->n_slots)
        return;
    place->slot = 0;
    place->cycle_tick += plan->cycle_ticks;
    if (++place->cycle_here < plan->cycles_per_object)
        return;
    place->cycle_here = 0;
    if (++place->object == NO_OBJECT)
        place->object = 0;
}

static void show(struct pans_device *d)
{
    if (d->hw.show != NULL)
        d->hw.show(d->hw.self, &d->edges.exposure);
}

static void name(struct pans_device *d)
{
    struct edges *e = &d->edges;
    const struct show *named = find_show(&d->shows, e->place.number);
    if (named == NULL)
        return;
    e->exposure.light = named->light;
    e->stamp = named->state;
    show(d);
}

void edges_named(struct pans_device *d)
{
    const struct edges *e = &d->edges;
    if (!e->exposing && e->tick != PANS_NEVER && d->plan.pattern[e->place.slot] == PANS_ADAPTIVE)
        name(d);
}

/* Make the exposure at `place` ready; the projector hears of it at once. */
static void prepare_next(struct pans_device *d)
{
    const struct plan *p = &d->plan;
    struct edges *e = &d->edges;
    struct pans_exposure *x = &e->exposure;
    uint32_t next[2];
    if (e->place.cycle_tick >= e->end_tick) {
        e->tick = PANS_NEVER;
        return;
    }
    if (e->place.slot == 0)
        e->node = 0;
    x->tick = e->tick = e->place.cycle_tick + p->start[e->place.slot];
    x->number = e->place.number;
    x->object = e->place.object;
    x->state = PANS_DARK;
    x->light = (struct pans_light){p->pattern[e->place.slot], 1, 1, x->ticks};
    e->stamp = x->light.pattern;
    if (p->adaptive && e->stamp == PANS_ADAPTIVE) {
        e->stamp = PANS_DARK;
        x->light.pattern = PANS_DARK;
        if (d->run.host_driven) {
            name(d);
            return;
        }
        if (e->node < d->automaton.n_states) {
            x->state = e->stamp = (uint16_t)e->node;
            x->light = light_of_state(d, e->stamp, next);
        }
    }
    show(d);
}

void edges_start(struct pans_device *d)
{
    struct edges *e = &d->edges;
    e->place = d->run.place;
    e->end_tick = d->run.end_tick;
    e->exposing = false;
    e->first = e->used = 0;
    e->missed = 0;
    e->word_bytes = d->plan.mode == 1 ? word_bytes(d->plan.n_patterns) : 1;
    e->exposure = (struct pans_exposure){.ticks = d->plan.exposure_ticks};
    prepare_next(d);
    e->on = true;
}

static void begin(struct pans_device *d)
{
    struct edges *e = &d->edges;
    e->began = d->hw.expose(d->hw.self, &e->exposure);
    e->exposing = true;
    e->tick = e->began + e->exposure.ticks; /* late, but as long as it should be */
}

static void finish(struct pans_device *d)
{
    struct edges *e = &d->edges;
    bool full = e->used == e->size;
    uint32_t at = full ? e->size : (uint32_t)e->first + e->used;
    if (!full && at >= e->size)
        at -= e->size;
    struct ended *ended = (struct ended *)(void *)(e->ended + at * e->stride);
    uint8_t *word = (uint8_t *)(ended + 1);
    memset(word, 0, e->word_bytes);
    uint64_t length = d->hw.clicks(d->hw.self, word, e->word_bytes) - e->began;
    if (e->exposure.state != PANS_DARK)
        e->node = d->automaton.row[e->node].next[word[0] & 1];
    uint16_t stamp = e->stamp;
    e->exposing = false;
    place_next(&d->plan, &e->place);
    prepare_next(d); /* first of all: the projector needs its time */
    ended->began = e->began;
    ended->length = length > UINT32_MAX ? UINT32_MAX : (uint32_t)length;
    ended->stamp = stamp;
    ended->missed = e->missed;
    if (full) {
        e->missed++;
        return;
    }
    e->missed = 0;
    e->used++;
}

uint64_t pans_edge_tick(const struct pans_device *d)
{
    uint64_t exposure = d->edges.on ? d->edges.tick : PANS_NEVER;
    return d->gates.next_tick < exposure ? d->gates.next_tick : exposure;
}

void pans_edge(struct pans_device *d)
{
    uint64_t exposure = d->edges.on ? d->edges.tick : PANS_NEVER;
    if (d->gates.next_tick <= exposure && d->gates.next_tick != PANS_NEVER)
        gates_switch(d);
    else if (exposure != PANS_NEVER && d->edges.exposing)
        finish(d);
    else if (exposure != PANS_NEVER)
        begin(d);
}
