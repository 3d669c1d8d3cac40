/* The device as a state machine: its memory, its time, the session and the commands. */
#include <string.h>

#include "internal.h"

/* -- memory -- */

struct carver {
    uint8_t *base; /* NULL: only the size is wanted */
    uint64_t used;
};

static void *carve(struct carver *c, uint64_t count, uint64_t size)
{
    uint64_t at = c->used;
    c->used += (count * size + 7) / 8 * 8;
    return c->base == NULL ? NULL : c->base + at;
}

/* One exposure that waits for the main loop, with room for its bits. */
static uint32_t ended_bytes(const struct pans_limits *l)
{
    uint32_t word = l->parallel ? word_bytes(l->channels) : 1u;
    return (uint32_t)sizeof(struct ended) + (word + 7u) / 8u * 8u;
}

#define PARTS 15

static struct pans_device *lay_out(struct carver *c, const struct pans_limits *l, uint8_t *parts[PARTS])
{
    struct pans_device *d = carve(c, 1, sizeof *d);
    const uint64_t sizes[PARTS] = {
        l->payload_bytes + (uint64_t)HEADER_BYTES + CRC_BYTES,
        l->pattern_memory * sizeof *d->patterns,
        l->slot_memory * (uint64_t)sizeof *d->plan.start,
        l->slot_memory * (uint64_t)sizeof *d->plan.pattern,
        l->automaton_states * sizeof *d->automaton.row,
        l->automaton_states * sizeof *d->automaton.depth,
        l->show_memory * sizeof *d->shows.at,
        l->gate_pulses * sizeof *d->gates.at,
        HEADER_BYTES + (uint64_t)l->block_bytes + CRC_BYTES,
        l->buffer_bytes,
        ANSWER_BYTES + PONG_BYTES,
        l->port_bytes,
        l->port_bytes,
        (l->pending_exposures + (uint64_t)1) * ended_bytes(l),
        l->gate_outputs * sizeof *d->gates.open,
    };
    for (int i = 0; i < PARTS; i++)
        parts[i] = carve(c, sizes[i], 1);
    return d;
}

static bool can_be_meant(const struct pans_limits *l)
{
    bool counted = l->tick_hz >= 1000 && l->tick_hz <= 10000000000u && l->channels != 0 && l->levels >= 2 && l->levels <= 65536;
    bool held = l->slot_memory != 0 && l->buffer_messages != 0 && l->buffer_bytes >= l->block_bytes + l->block_bytes / 254 + 32;
    bool sized = l->block_bytes >= BLOCK_HEADER + 3 && l->block_bytes <= MAX_PAYLOAD && l->payload_bytes >= 64 && l->port_bytes != 0;
    bool waits = l->pending_exposures >= 2;
    bool automata = l->dwell_steps == 0 || (!l->parallel && l->show_memory >= 64);
    return counted && held && sized && waits && automata && l->payload_bytes <= MAX_PAYLOAD && l->firmware != NULL && l->serial != NULL;
}

size_t pans_memory_bytes(const struct pans_limits *limits)
{
    struct carver carver = {NULL, 0};
    uint8_t *parts[PARTS];
    if (!can_be_meant(limits))
        return 0;
    lay_out(&carver, limits, parts);
    return carver.used > SIZE_MAX ? 0 : (size_t)carver.used;
}

struct pans_device *pans_start(const struct pans_limits *limits, const struct pans_hardware *hardware, void *memory, size_t bytes,
                               uint64_t tick)
{
    size_t needed = pans_memory_bytes(limits);
    struct carver carver = {memory, 0};
    uint8_t *parts[PARTS];
    if (memory == NULL || needed == 0 || needed > bytes)
        return NULL;
    struct pans_device *d = lay_out(&carver, limits, parts);
    memset(memory, 0, needed);
    d->limits = *limits;
    d->hw = *hardware;
    d->tick = tick;
    d->reason = POWER_ON;
    d->status_tick = d->gates.next_tick = PANS_NEVER;
    decoder_init(&d->decoder, parts[0], limits->payload_bytes + HEADER_BYTES + CRC_BYTES);
    d->patterns = (struct pattern *)(void *)parts[1];
    d->plan.start = (uint64_t *)(void *)parts[2];
    d->plan.pattern = (uint16_t *)(void *)parts[3];
    d->automaton.row = (struct state_row *)(void *)parts[4];
    d->automaton.depth = (uint16_t *)(void *)parts[5];
    d->shows.at = (struct show *)(void *)parts[6];
    d->gates.at = (struct pulse *)(void *)parts[7];
    d->stream.block.body = parts[8];
    ring_init(&d->stream.ring, parts[9], limits->buffer_bytes);
    ring_init(&d->answers, parts[10], ANSWER_BYTES);
    ring_init(&d->pong_ring, parts[10] + ANSWER_BYTES, PONG_BYTES);
    d->received = parts[11];
    d->staged = parts[12];
    d->edges.ended = parts[13];
    d->edges.size = limits->pending_exposures;
    d->edges.stride = ended_bytes(limits);
    d->gates.open = (uint16_t *)(void *)parts[14];
    return d;
}

/* -- time -- */

static uint64_t least(uint64_t a, uint64_t b)
{
    return a < b ? a : b;
}

/* The next event but for edges. A run is over at its end, or once the last exposure has ended and is known. */
static uint64_t next_event(struct pans_device *d)
{
    uint64_t due = d->status_tick;
    if (d->run.active)
        due = least(due, d->run.lease_tick);
    if (d->run.active && d->state == PANS_ARMED)
        due = least(due, d->run.start_tick);
    else if (d->run.active && d->run.end_tick < due && run_is_over(d))
        due = d->run.end_tick;
    return due;
}

uint64_t pans_next_tick(const struct pans_device *device)
{
    struct pans_device *d = (struct pans_device *)(uintptr_t)device; /* looking takes hold of it */
    hold(d, true);
    uint64_t edge = d->edges.used != 0 ? d->tick : pans_edge_tick(d); /* what has ended waits to be taken up */
    hold(d, false);
    return least(next_event(d), edge);
}

/* One event that is due at the present tick; of several the first in this order, the others come with the next call. */
static void happen(struct pans_device *d)
{
    if (d->run.active && d->state == PANS_ARMED && d->run.start_tick <= d->tick) {
        d->state = PANS_RUNNING;
        d->reason = NO_REASON;
        send_status(d);
    } else if (d->run.active && d->state == PANS_RUNNING && d->run.end_tick <= d->tick && run_is_over(d)) {
        run_end(d, PANS_IDLE, COMPLETED);
    } else if (d->run.active && d->run.lease_tick <= d->tick) {
        d->counters.lease_expiries++;
        run_end(d, PANS_SAFE, LEASE_EXPIRED);
    } else if (d->status_tick <= d->tick) {
        send_status(d);
    }
}

static void advance(struct pans_device *d, uint64_t tick)
{
    for (;;) {
        run_collect(d);
        uint64_t due = next_event(d);
        if (d->hw.hold == NULL && pans_edge_tick(d) <= least(due, tick)) {
            pans_edge(d);
            continue;
        }
        if (due > tick)
            break;
        d->tick = due > d->tick ? due : d->tick;
        happen(d);
    }
    d->tick = tick > d->tick ? tick : d->tick;
}

/* -- the session -- */

static void forget_session(struct pans_device *d)
{
    gates_close(d);
    forget_patterns(d);
    d->plan.complete = d->plan.adaptive = false;
    d->plan.filled = 0;
    forget_states(d);
    d->ack = (struct ack){0};
    d->run.place = (struct place){0};
    d->evidence = (struct evidence){0};
    d->n_pongs = 0;
    d->status_tick = PANS_NEVER;
    ring_forget(&d->answers, d->sending == OF_ANSWERS);
    ring_forget(&d->pong_ring, d->sending == OF_PONGS);
    d->stream.limit = 0;
    stream_restart(d);
}

static void hello(struct pans_device *d, uint32_t session, const uint8_t *payload)
{
    bool same = get32(payload) == PANS_SCHEMA && get16(payload + 4) == PANS_PROTOCOL;
    if (session == d->session && same) { /* a repetition: starting afresh would let commands be executed twice */
        send_welcome(d, session);
        send_status(d);
        return;
    }
    run_end(d, PANS_IDLE, STOPPED);
    forget_session(d);
    send_welcome(d, session);
    d->session = same ? session : 0; /* another schema would misread every further byte */
    send_status(d);
}

/* -- commands -- */

static enum pans_status stop(struct pans_device *d, enum opcode opcode, uint32_t count)
{
    if (count != 0)
        return refuse_number(d, PANS_MALFORMED, "number of bytes after STOP or RESET", count, 0);
    run_end(d, PANS_IDLE, STOPPED);
    if (opcode == RESET && d->state == PANS_SAFE)
        enter(d, PANS_IDLE, NO_REASON);
    return PANS_DONE;
}

static enum pans_status execute(struct pans_device *d, uint8_t opcode, const uint8_t *body, uint32_t count)
{
    if (opcode == 0 || opcode > SHOW || (opcode > GATE && d->limits.dwell_steps == 0))
        return refuse_number(d, PANS_UNKNOWN, "opcode", opcode, d->limits.dwell_steps == 0 ? GATE : SHOW);
    bool needs_idle = opcode <= ARM || opcode == LOAD_MASKS || opcode == LOAD_STATES;
    if (needs_idle && d->state != PANS_IDLE)
        return refuse(d, PANS_WRONG_STATE, d->state == PANS_SAFE ? "the device is SAFE: RESET leaves it" : "the device is not IDLE");
    switch ((enum opcode)opcode) {
    case LOAD_PATTERN:
        return load_pattern(d, body, count);
    case LOAD_PLAN:
        return load_plan(d, body, count);
    case ARM:
        return arm(d, body, count);
    case GATE:
        return take_gate(d, body, count);
    case LOAD_MASKS:
        return load_masks(d, body, count);
    case LOAD_STATES:
        return load_states(d, body, count);
    case SHOW:
        return take_show(d, body, count);
    case STOP:
    case RESET:
        break;
    }
    return stop(d, (enum opcode)opcode, count);
}

static void command(struct pans_device *d, const uint8_t *payload, uint32_t count)
{
    uint32_t id = get32(payload);
    if (id == d->ack.last + 1) {
        d->ack.last = id;
        d->ack.mask <<= 1;
        enum pans_status status = execute(d, payload[4], payload + 8, count - 8);
        if (status != PANS_DONE) {
            d->counters.refused++;
            d->ack.refused = id;
            d->ack.mask |= 1;
            d->ack.status = (uint16_t)status;
            d->ack.text_bytes = d->why_bytes;
            memcpy(d->ack.text, d->why, d->why_bytes);
        }
    } else if (id <= d->ack.last) {
        d->counters.repeated++;
    } else {
        d->counters.out_of_order++;
    }
    send_ack(d);
}

static void grant(struct pans_device *d, const uint8_t *payload)
{
    uint32_t lease_ms = get32(payload + 4);
    d->stream.limit = get32(payload);
    if (lease_ms != 0 && d->run.active)
        renew_lease(d, lease_ms);
}

static void receive(struct pans_device *d, uint32_t bytes)
{
    const uint8_t *body = d->decoder.body, *payload = body + HEADER_BYTES;
    uint32_t session = get32(body + 4), count = bytes - HEADER_BYTES - CRC_BYTES;
    d->counters.frames++;
    if (body[0] == HELLO && count >= 8 && session != 0)
        hello(d, session, payload);
    else if (body[0] == HELLO)
        d->counters.malformed++;
    else if (d->session == 0 || session != d->session)
        d->counters.foreign++;
    else if (body[0] == PING && count == 12)
        take_ping(d, payload);
    else if (body[0] == GRANT && count == 8)
        grant(d, payload);
    else if (body[0] == COMMAND && count >= 8)
        command(d, payload, count);
    else if (body[0] == PING || body[0] == GRANT || body[0] == COMMAND)
        d->counters.malformed++;
    else
        d->counters.unknown++;
}

/* -- bytes in, bytes out -- */

void pans_step(struct pans_device *d, uint64_t tick, const uint8_t *data, size_t count)
{
    uint32_t bytes;
    advance(d, tick);
    for (size_t i = 0; i < count; i++) {
        enum arrival arrival = decoder_take(&d->decoder, data[i], &bytes);
        if (arrival == FRAME)
            receive(d, bytes);
        d->counters.damaged += arrival == DAMAGED;
    }
}

static enum sending choose(struct pans_device *d)
{
    if (d->n_pongs != 0) {
        frame_pong(d);
        return OF_PONGS;
    }
    bool stream = stream_may_send(d), answers = d->answers.used != 0;
    if (stream && !(answers && d->stream_was_last)) { /* in turn: a block goes before the STATUS that was made after it */
        d->stream_was_last = true;
        return OF_STREAM;
    }
    d->stream_was_last = false;
    return answers ? OF_ANSWERS : NONE;
}

static struct ring *ring_of(struct pans_device *d)
{
    if (d->sending == OF_PONGS)
        return &d->pong_ring;
    return d->sending == OF_ANSWERS ? &d->answers : &d->stream.ring;
}

size_t pans_output(struct pans_device *d, uint64_t tick, uint8_t *out, size_t room)
{
    size_t sent = 0;
    advance(d, tick); /* nothing that is stamped later may bear a tick before that of a PONG */
    while (sent < room) {
        bool ended;
        if (d->sending == NONE)
            d->sending = choose(d);
        if (d->sending == NONE)
            break;
        sent += ring_take(ring_of(d), out + sent, room - sent, &ended);
        if (!ended)
            break;
        d->stream.held -= d->sending == OF_STREAM;
        d->sending = NONE;
    }
    return sent;
}

bool pans_turn(struct pans_device *d)
{
    while (d->hw.hold == NULL && pans_edge_tick(d) - d->limits.lead_ticks <= d->hw.now(d->hw.self)) /* PANS_NEVER is never */
        pans_edge(d);
    size_t room = d->limits.port_bytes, count = d->hw.read(d->hw.self, d->received, room);
    pans_step(d, d->hw.now(d->hw.self), d->received, count);
    if (d->staged_from == d->staged_to) {
        d->staged_from = 0;
        d->staged_to = pans_output(d, d->hw.now(d->hw.self), d->staged, room);
    }
    size_t took = d->hw.write(d->hw.self, d->staged + d->staged_from, d->staged_to - d->staged_from);
    d->staged_from += took;
    return count != 0 || took != 0;
}

bool pans_has_output(const struct pans_device *d)
{
    return d->staged_from != d->staged_to;
}

enum pans_state pans_state_of(const struct pans_device *d)
{
    return d->state;
}

const struct pans_counters *pans_counters_of(const struct pans_device *d)
{
    return &d->counters;
}
