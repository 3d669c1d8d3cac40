/* A run: ARM, exposure after exposure, and its end. */
#include <string.h>

#include "internal.h"

#define MAX_AHEAD_S 3600u

enum pans_status prepare(struct pans_device *d)
{
    const char *why = "the hardware is not ready";
    struct pans_task task = {
        .patterns_revision = d->patterns_revision,
        .states_revision = d->automaton.revision,
        .n_patterns = d->plan.n_patterns,
        .n_states = d->automaton.complete ? d->automaton.n_states : 0,
        .adaptive = d->plan.adaptive,
        .exposure_ticks = d->plan.exposure_ticks,
        .state = light_of_state,
        .device = d,
    };
    enum pans_status status = d->hw.prepare(d->hw.self, &task, &why);
    return status == PANS_DONE ? PANS_DONE : refuse(d, status, why);
}

void enter(struct pans_device *d, enum pans_state state, enum reason reason)
{
    d->state = state;
    d->reason = reason;
    send_status(d);
}

void renew_lease(struct pans_device *d, uint32_t lease_ms)
{
    uint64_t ms = lease_ms > MAX_LEASE_MS ? MAX_LEASE_MS : lease_ms, ticks = ms * d->limits.tick_hz / 1000;
    d->run.lease_tick = d->tick + (ticks == 0 ? 1 : ticks);
}

static enum pans_status check_arm(struct pans_device *d, uint64_t start, uint64_t cycles, uint32_t lease_ms)
{
    const struct plan *p = &d->plan;
    if (!p->complete)
        return refuse(d, PANS_WRONG_STATE, "no complete plan is loaded");
    if (start <= d->tick)
        return refuse_number(d, PANS_LATE, "start tick, which has passed: it", start, d->tick + 1);
    if (start - d->tick > MAX_AHEAD_S * d->limits.tick_hz)
        return refuse_number(d, PANS_RANGE, "start tick", start, d->tick + MAX_AHEAD_S * d->limits.tick_hz);
    if (lease_ms == 0 || lease_ms > MAX_LEASE_MS)
        return refuse_number(d, PANS_RANGE, "lease in ms", lease_ms, MAX_LEASE_MS);
    uint64_t longest = p->cycle_ticks > p->n_slots ? p->cycle_ticks : p->n_slots;
    if (start >= LAST_TICK || cycles > (LAST_TICK - 1 - start) / longest)
        return refuse_number(d, PANS_RANGE, "number of cycles", cycles, start >= LAST_TICK ? 0 : (LAST_TICK - 1 - start) / longest);
    if (d->automaton.begun && !d->automaton.complete)
        return refuse_number(d, PANS_WRONG_STATE, "number of states that have come", d->automaton.filled, d->automaton.n_states);
    return require_patterns(d);
}

enum pans_status arm(struct pans_device *d, const uint8_t *body, uint32_t count)
{
    if (count != 24)
        return refuse_number(d, PANS_MALFORMED, "ARM: number of bytes", count, 24);
    uint64_t start = get64(body), cycles = get64(body + 8);
    uint32_t lease_ms = get32(body + 16);
    enum pans_status status = check_arm(d, start, cycles, lease_ms);
    if (status == PANS_DONE)
        status = prepare(d);
    if (status != PANS_DONE)
        return status;
    d->run = (struct run){
        .active = true,
        .host_driven = d->plan.adaptive && !d->automaton.complete,
        .start_tick = start,
        .cycles = cycles,
        .end_tick = cycles == 0 ? PANS_NEVER : start + cycles * d->plan.cycle_ticks,
        .place = {.cycle_tick = start},
    };
    d->shows.count = 0;
    d->evidence = (struct evidence){0};
    stream_restart(d);
    hold(d, true);
    edges_start(d);
    hold(d, false);
    renew_lease(d, lease_ms);
    enter(d, PANS_ARMED, NO_REASON);
    return PANS_DONE;
}

uint64_t run_begun(struct pans_device *d)
{
    hold(d, true);
    uint64_t begun = d->edges.place.number + d->edges.exposing;
    hold(d, false);
    return begun;
}

bool run_is_over(struct pans_device *d)
{
    hold(d, true);
    bool over = d->edges.tick == PANS_NEVER && d->edges.used == 0;
    hold(d, false);
    return over;
}

static int32_t clamped(uint64_t after, uint64_t before)
{
    bool late = after >= before;
    uint64_t far = late ? after - before : before - after;
    int32_t error = far > INT32_MAX ? INT32_MAX : (int32_t)far;
    return late ? error : -error;
}

static void judge(struct pans_device *d, const struct ended *ended)
{
    struct evidence *e = &d->evidence;
    const struct place *at = &d->run.place;
    int32_t start = clamped(ended->began, at->cycle_tick + d->plan.start[at->slot]);
    int32_t length = clamped(ended->length, d->plan.exposure_ticks);
    if (e->exposures == 0 || (start < 0 ? -start : start) > (e->start < 0 ? -e->start : e->start)) {
        e->start = start;
        e->start_at = at->number;
    }
    if (e->exposures == 0 || (length < 0 ? -length : length) > (e->length < 0 ? -e->length : e->length)) {
        e->length = length;
        e->length_at = at->number;
    }
    e->exposures++;
}

static void mark(struct pans_device *d)
{
    struct run *run = &d->run;
    const struct place *at = &run->place;
    if (run->marked || at->slot != 0 || at->cycle_here != 0)
        return;
    stream_mark(d, at->object, at->number, at->cycle_tick + d->plan.start[0]);
    run->marked = true;
}

/* The exposure at run.place is done with. */
static void next_place(struct run *run, const struct plan *plan)
{
    place_next(plan, &run->place);
    run->marked = run->marked && (run->place.slot != 0 || run->place.cycle_here != 0);
}

/* Exposures that ended without room to tell of them: they count as dropped. */
static void lose(struct pans_device *d, uint32_t missed)
{
    if (missed != 0)
        stream_close_block(d);
    d->stream.drops += missed;
    for (; missed != 0; missed--) {
        mark(d);
        next_place(&d->run, &d->plan);
    }
}

static void collect_one(struct pans_device *d, const struct ended *ended)
{
    const struct plan *p = &d->plan;
    struct place *at = &d->run.place;
    lose(d, ended->missed);
    mark(d);
    judge(d, ended);
    stream_add(d, ended);
    if (at->slot + 1 == p->n_slots || d->stream.block.count == p->block_exposures || gap_after(p, at->slot) != p->period_ticks)
        stream_close_block(d);
    next_place(&d->run, p);
}

void run_collect(struct pans_device *d)
{
    struct edges *e = &d->edges;
    while (d->run.active) {
        hold(d, true);
        uint16_t used = e->used, first = e->first;
        uint64_t begun = e->place.number + e->exposing;
        hold(d, false);
        if (used == 0) {
            if (begun > d->run.place.number)
                mark(d); /* as soon as its first exposure has begun */
            return;
        }
        collect_one(d, (const struct ended *)(const void *)(e->ended + first * e->stride));
        hold(d, true);
        e->first = (uint16_t)(first + 1) == e->size ? 0 : (uint16_t)(first + 1);
        e->used--;
        hold(d, false);
    }
}

/* Leave ARMED or RUNNING: what was exposed is sent, one exposure under way is not counted, and the light goes out. */
void run_end(struct pans_device *d, enum pans_state state, enum reason reason)
{
    if (!d->run.active)
        return;
    hold(d, true);
    d->edges.on = d->edges.exposing = false;
    hold(d, false);
    d->hw.dark(d->hw.self);
    run_collect(d);
    lose(d, d->edges.missed);
    stream_close_block(d);
    d->run.active = false;
    d->shows.count = 0;
    if (reason != COMPLETED)
        gates_close(d);
    enter(d, state, reason);
}
