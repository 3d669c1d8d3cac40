/* Automata (protocol.md, section 11): LOAD_STATES, SHOW, and from click to click. */
#include <string.h>

#include "internal.h"

#define ROW_BYTES 12u
#define MAX_STATES_HERE 4096u

void forget_states(struct pans_device *d)
{
    struct state_row *row = d->automaton.row;
    uint16_t *depth = d->automaton.depth;
    uint32_t revision = d->automaton.revision + 1;
    memset(&d->automaton, 0, sizeof d->automaton);
    d->automaton.row = row;
    d->automaton.depth = depth;
    d->automaton.revision = revision;
}

static enum pans_status check_steps(struct pans_device *d, uint16_t steps)
{
    if (steps == 0 || d->limits.dwell_steps % steps != 0)
        return refuse_number(d, PANS_RANGE, "number of dwell steps, which is no divisor: it", steps, d->limits.dwell_steps);
    return PANS_DONE;
}

struct states_here {
    uint16_t n_states, first, dwell_steps;
    uint32_t n_leaves, count;
    const uint8_t *rows;
};

static enum pans_status check_head(struct pans_device *d, const struct states_here *here)
{
    const struct automaton *a = &d->automaton;
    uint32_t most = d->limits.automaton_states < MAX_STATES ? d->limits.automaton_states : MAX_STATES;
    if (!d->plan.complete || !d->plan.adaptive)
        return refuse(d, PANS_WRONG_STATE, "no plan with adaptive slots is loaded");
    if (here->n_states > most)
        return refuse_number(d, PANS_RANGE, "number of states", here->n_states, most);
    if (here->n_leaves == 0 || here->n_leaves > MAX_LEAVES)
        return refuse_number(d, PANS_RANGE, "number of leaves", here->n_leaves, MAX_LEAVES);
    bool same = here->n_states == a->n_states && here->dwell_steps == a->dwell_steps && here->n_leaves == a->n_leaves;
    if (here->first != 0 && (!a->begun || a->complete || !same || here->first != a->filled))
        return refuse_number(d, PANS_RANGE, "first state", here->first, a->begun && !a->complete ? a->filled : 0);
    return check_steps(d, here->dwell_steps);
}

static enum pans_status check_rows(struct pans_device *d, const struct states_here *here)
{
    uint32_t nodes = here->n_states + here->n_leaves;
    for (uint32_t i = 0; i < here->count; i++) {
        const uint8_t *row = here->rows + ROW_BYTES * i;
        uint16_t pattern = get16(row), dwell = get16(row + 2);
        if (pattern >= d->plan.n_patterns)
            return refuse_number(d, PANS_RANGE, "pattern of a state", pattern, d->plan.n_patterns - 1u);
        if (dwell == 0 || dwell > here->dwell_steps)
            return refuse_number(d, PANS_RANGE, "dwell", dwell, here->dwell_steps);
        for (uint32_t click = 0; click < 2; click++) {
            uint32_t next = get32(row + 4 + 4 * click);
            if (next <= here->first + i || next >= nodes)
                return refuse_number(d, PANS_RANGE, "successor of a state", next, nodes - 1);
        }
    }
    return PANS_DONE;
}

/* The walk to a state is known when the state comes, since every successor is a higher number. */
static void append_row(struct automaton *a, const uint8_t *row)
{
    uint16_t number = a->filled++;
    a->row[number] = (struct state_row){get16(row), get16(row + 2), {get32(row + 4), get32(row + 8)}};
    uint16_t depth = a->depth[number];
    if (depth > a->longest)
        a->longest = depth;
    for (uint32_t click = 0; depth != 0 && click < 2; click++) {
        uint32_t next = a->row[number].next[click];
        if (next < a->n_states && a->depth[next] <= depth)
            a->depth[next] = (uint16_t)(depth + 1);
    }
}

static uint64_t closest_gap(const struct plan *plan)
{
    uint64_t closest = PANS_NEVER;
    for (uint32_t i = 0; i < plan->n_slots; i++) {
        uint64_t gap = gap_after(plan, i) - plan->exposure_ticks;
        closest = gap < closest ? gap : closest;
    }
    return closest;
}

static enum pans_status complete(struct pans_device *d)
{
    uint16_t longest = d->automaton.longest;
    uint64_t closest = closest_gap(&d->plan);
    if (longest <= d->plan.adaptive_slots && closest >= d->limits.turn_ticks) {
        d->automaton.complete = true;
        if (require_patterns(d) == PANS_DONE)
            prepare(d);
        return PANS_DONE;
    }
    forget_states(d);
    if (longest > d->plan.adaptive_slots)
        return refuse_number(d, PANS_RANGE, "longest walk", longest, d->plan.adaptive_slots);
    return refuse_number(d, PANS_RANGE, "least ticks to choose the next pattern in", closest, d->limits.turn_ticks);
}

enum pans_status load_states(struct pans_device *d, const uint8_t *body, uint32_t count)
{
    if (count < 12 || (count - 12) % ROW_BYTES != 0)
        return refuse(d, PANS_MALFORMED, "LOAD_STATES: a header of 12 bytes, and states of 12");
    struct states_here here = {get16(body), get16(body + 2), get16(body + 4), get32(body + 8), (count - 12) / ROW_BYTES, body + 12};
    if (here.count == 0 || here.count > MAX_STATES_HERE || here.first + here.count > here.n_states)
        return refuse_number(d, PANS_MALFORMED, "LOAD_STATES: last state", here.first + here.count, here.n_states);
    enum pans_status status = check_head(d, &here);
    if (status == PANS_DONE)
        status = check_rows(d, &here);
    if (status != PANS_DONE)
        return status;
    struct automaton *a = &d->automaton;
    if (here.first == 0) {
        forget_states(d);
        a->begun = true;
        a->n_states = here.n_states;
        a->dwell_steps = here.dwell_steps;
        a->n_leaves = here.n_leaves;
        a->step_ticks = (((uint64_t)d->plan.exposure_ticks << 32) + here.dwell_steps - 1) / here.dwell_steps;
        memset(a->depth, 0, here.n_states * sizeof a->depth[0]);
        a->depth[0] = 1;
    }
    for (uint32_t i = 0; i < here.count; i++)
        append_row(a, here.rows + ROW_BYTES * i);
    return a->filled < a->n_states ? PANS_DONE : complete(d);
}

/* -- what the host names -- */

const struct show *find_show(const struct shows *shows, uint64_t exposure)
{
    for (uint16_t i = 0; i < shows->count; i++)
        if (shows->at[i].exposure == exposure)
            return shows->at + i;
    return NULL;
}

static enum pans_status check_show(struct pans_device *d, const struct show *show)
{
    const struct plan *p = &d->plan;
    if (show->light.pattern >= p->n_patterns)
        return refuse_number(d, PANS_RANGE, "pattern", show->light.pattern, p->n_patterns - 1u);
    enum pans_status status = check_steps(d, show->light.dwell_steps);
    if (status != PANS_DONE)
        return status;
    if (show->light.dwell == 0 || show->light.dwell > show->light.dwell_steps)
        return refuse_number(d, PANS_RANGE, "dwell", show->light.dwell, show->light.dwell_steps);
    if (show->state >= MAX_STATES)
        return refuse_number(d, PANS_RANGE, "state", show->state, MAX_STATES - 1);
    if (d->run.cycles != 0 && show->exposure >= d->run.cycles * p->n_slots)
        return refuse_number(d, PANS_RANGE, "exposure", show->exposure, d->run.cycles * p->n_slots - 1);
    if (p->pattern[show->exposure % p->n_slots] != PANS_ADAPTIVE)
        return refuse_number(d, PANS_RANGE, "exposure, which is dark: its number", show->exposure, run_begun(d));
    return PANS_DONE;
}

/* Names of exposures that have begun make room. */
static void forget_shown(struct shows *shows, uint64_t begun)
{
    for (uint16_t i = 0; i < shows->count;)
        if (shows->at[i].exposure < begun)
            shows->at[i] = shows->at[--shows->count];
        else
            i++;
}

enum pans_status take_show(struct pans_device *d, const uint8_t *body, uint32_t count)
{
    if (!d->run.active || !d->run.host_driven)
        return refuse(d, PANS_WRONG_STATE, "SHOW needs a run whose states the host names");
    if (count != 16)
        return refuse_number(d, PANS_MALFORMED, "SHOW: number of bytes", count, 16);
    struct show show = {get64(body), get16(body + 8), {get16(body + 10), get16(body + 12), get16(body + 14), 0}};
    enum pans_status status = check_show(d, &show);
    if (status != PANS_DONE)
        return status;
    show.light.ticks = (uint32_t)((uint64_t)d->plan.exposure_ticks * show.light.dwell / show.light.dwell_steps);
    struct shows *shows = &d->shows;
    hold(d, true);
    uint64_t begun = d->edges.place.number + d->edges.exposing;
    forget_shown(shows, begun);
    const struct show *known = find_show(shows, show.exposure);
    if (show.exposure < begun) {
        status = PANS_LATE;
    } else if (known == NULL && shows->count == d->limits.show_memory) {
        status = PANS_RANGE;
    } else {
        shows->at[known == NULL ? shows->count++ : (uint16_t)(known - shows->at)] = show;
        edges_named(d);
    }
    hold(d, false);
    if (status == PANS_LATE)
        return refuse_number(d, status, "exposure, which has begun: its number", show.exposure, begun);
    if (status == PANS_RANGE)
        return refuse_number(d, status, "number of exposures that are named", shows->count + 1u, d->limits.show_memory);
    return status;
}

struct pans_light light_of_state(const void *device, uint16_t number, uint32_t next[2])
{
    const struct pans_device *d = device;
    const struct state_row *row = d->automaton.row + number;
    next[0] = row->next[0];
    next[1] = row->next[1];
    return (struct pans_light){row->pattern, row->dwell, d->automaton.dwell_steps, (uint32_t)(d->automaton.step_ticks * row->dwell >> 32)};
}
