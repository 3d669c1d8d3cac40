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
        .cycle_tick = start,
        .next_tick = start + d->plan.start[0],
    };
    d->shows.count = 0;
    stream_restart(d);
    renew_lease(d, lease_ms);
    enter(d, PANS_ARMED, NO_REASON);
    return PANS_DONE;
}

uint64_t run_next_tick(const struct pans_device *d)
{
    return d->state == PANS_RUNNING ? d->run.next_tick : PANS_NEVER;
}

static void begin(struct pans_device *d)
{
    struct run *run = &d->run;
    uint64_t visit = run->cycle / d->plan.cycles_per_object;
    struct pans_exposure exposure = {
        .tick = run->next_tick,
        .number = run->begun,
        .object = (uint32_t)(visit % NO_OBJECT),
        .ticks = d->plan.exposure_ticks,
        .state = PANS_DARK,
    };
    if (run->slot == 0) {
        run->node = 0;
        if (run->cycle == visit * d->plan.cycles_per_object)
            stream_mark(d, exposure.object, run->begun, run->next_tick);
    }
    exposure.light = light_now(d, &run->stamp);
    if (d->plan.adaptive && !run->host_driven)
        exposure.state = run->stamp;
    run->began_at = d->hw.expose(d->hw.self, &exposure);
    run->exposing = true;
    run->begun++;
    run->next_tick += d->plan.exposure_ticks;
}

static void finish(struct pans_device *d)
{
    struct run *run = &d->run;
    const struct plan *p = &d->plan;
    uint8_t bit = 0, *word = p->mode == 1 ? stream_word(d) : &bit;
    uint16_t bytes = p->mode == 1 ? word_bytes(p->n_patterns) : 1;
    memset(word, 0, bytes);
    d->hw.clicks(d->hw.self, word, bytes);
    stream_add(d, bit & 1, run->begun - 1, (uint32_t)(run->cycle / p->cycles_per_object % NO_OBJECT));
    walk_on(d, bit & 1);
    run->exposing = false;
    run->ended++;
    bool last = run->slot + 1 == p->n_slots;
    if (last || d->stream.block.count == p->block_exposures || gap_after(p, run->slot) != p->period_ticks)
        stream_close_block(d);
    run->slot++;
    if (last) {
        run->slot = 0;
        run->cycle++;
        run->cycle_tick += p->cycle_ticks;
    }
    bool over = run->cycles != 0 && run->cycle == run->cycles;
    run->next_tick = over ? PANS_NEVER : run->cycle_tick + p->start[run->slot];
}

void run_do_due(struct pans_device *d, uint64_t tick)
{
    while (d->state == PANS_RUNNING && d->run.next_tick <= tick) {
        if (d->run.exposing)
            finish(d);
        else
            begin(d);
    }
}

/* Leave ARMED or RUNNING: what was exposed is sent, one exposure under way is not counted, and the light goes out. */
void run_end(struct pans_device *d, enum pans_state state, enum reason reason)
{
    if (!d->run.active)
        return;
    stream_close_block(d);
    d->run.active = d->run.exposing = false;
    d->shows.count = 0;
    d->hw.dark(d->hw.self);
    if (reason != COMPLETED)
        gates_close(d);
    enter(d, state, reason);
}
