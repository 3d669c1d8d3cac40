/* What the device answers: WELCOME, PONG, ACK and STATUS, and the texts of refusals. */
#include <string.h>

#include "internal.h"

/* -- refusals -- */

static uint16_t add_text(char *text, uint16_t at, const char *words)
{
    while (*words != '\0' && at < TEXT_BYTES)
        text[at++] = *words++;
    return at;
}

static uint16_t add_number(char *text, uint16_t at, uint64_t number)
{
    char digits[21];
    size_t first = sizeof digits - 1;
    digits[first] = '\0';
    do {
        digits[--first] = (char)('0' + number % 10);
        number /= 10;
    } while (number != 0);
    return add_text(text, at, digits + first);
}

enum pans_status refuse(struct pans_device *d, enum pans_status status, const char *why)
{
    d->why_bytes = add_text(d->why, 0, why);
    return status;
}

enum pans_status refuse_number(struct pans_device *d, enum pans_status status, const char *what, uint64_t found, uint64_t allowed)
{
    uint16_t at = add_text(d->why, 0, what);
    at = add_number(d->why, add_text(d->why, at, " is "), found);
    d->why_bytes = add_number(d->why, add_text(d->why, at, ", allowed "), allowed);
    return status;
}

/* -- answers -- */

static bool send(struct pans_device *d, uint32_t payload_bytes, enum message type, uint32_t session)
{
    bool put = ring_put_frame(&d->answers, d->scratch, HEADER_BYTES + payload_bytes, type, session);
    if (!put)
        d->counters.answers_lost++; /* the line takes nothing: the host asks again, and STATUS comes every second */
    return put;
}

void send_ack(struct pans_device *d)
{
    uint8_t *at = d->scratch + HEADER_BYTES;
    put32(at, d->ack.last);
    put32(at + 4, d->ack.refused);
    put32(at + 8, d->ack.mask);
    put16(at + 12, d->ack.status);
    put16(at + 14, d->ack.text_bytes);
    memcpy(at + 16, d->ack.text, d->ack.text_bytes);
    send(d, 16u + d->ack.text_bytes, ACK, d->session);
}

static void send_exposed(struct pans_device *d)
{
    const struct evidence *e = &d->evidence;
    uint8_t *at = d->scratch + HEADER_BYTES;
    put32(at, e->exposures);
    put32(at + 4, (uint32_t)e->start);
    put32(at + 8, (uint32_t)e->length);
    put64(at + 12, e->start_at);
    put64(at + 20, e->length_at);
    if (send(d, 28, EXPOSED, d->session))
        d->evidence = (struct evidence){0}; /* what found no room goes with the next one */
}

void send_status(struct pans_device *d)
{
    if (d->session == 0)
        return;
    if (d->evidence.exposures != 0)
        send_exposed(d);
    d->status_tick = d->tick + d->limits.tick_hz;
    uint64_t left = d->run.active ? d->run.lease_tick - d->tick : 0;
    uint64_t hz = d->limits.tick_hz;
    uint8_t *at = d->scratch + HEADER_BYTES;
    at[0] = (uint8_t)d->state;
    at[1] = (uint8_t)d->reason;
    put16(at + 2, 0);
    put32(at + 4, (uint32_t)(left / hz * 1000 + left % hz * 1000 / hz));
    put32(at + 8, d->stream.drops);
    put64(at + 12, d->tick);
    put64(at + 20, d->run.active ? run_begun(d) : d->run.place.number);
    send(d, 28, STATUS, d->session);
}

void take_ping(struct pans_device *d, const uint8_t *payload)
{
    if (d->n_pongs == PONGS) {
        d->counters.answers_lost++;
        return;
    }
    d->pong[d->n_pongs++] = (struct pong){get32(payload), get64(payload + 4), d->tick};
}

/* The tick of departure is known only now, when the line takes bytes again. */
void frame_pong(struct pans_device *d)
{
    uint8_t body[HEADER_BYTES + 28 + CRC_BYTES];
    put32(body + HEADER_BYTES, d->pong[0].id);
    put64(body + HEADER_BYTES + 4, d->pong[0].host_ns);
    put64(body + HEADER_BYTES + 12, d->pong[0].arrival);
    put64(body + HEADER_BYTES + 20, d->tick);
    ring_put_frame(&d->pong_ring, body, HEADER_BYTES + 28, PONG, d->session);
    d->n_pongs--;
    memmove(d->pong, d->pong + 1, d->n_pongs * sizeof d->pong[0]);
}

/* -- WELCOME's map, as msgpack -- */

struct map {
    uint8_t *at, *end;
    uint16_t entries;
};

static void add_string(struct map *map, const char *text)
{
    size_t count = strlen(text);
    count = count > 255 ? 255 : count; /* a receiver takes at most 256 bytes of text */
    if ((size_t)(map->end - map->at) < count + 2)
        count = 0;
    *map->at++ = 0xD9;
    *map->at++ = (uint8_t)count;
    memcpy(map->at, text, count);
    map->at += count;
}

static bool has_room(const struct map *map, const char *key, const char *text)
{
    size_t needed = strlen(key) + 2 + (text == NULL ? 9 : strlen(text) + 2);
    return (size_t)(map->end - map->at) >= needed + 2;
}

static void add_value(struct map *map, const char *key, uint64_t number)
{
    if (!has_room(map, key, NULL))
        return;
    add_string(map, key);
    *map->at++ = 0xCF;
    for (int shift = 56; shift >= 0; shift -= 8) /* msgpack is big-endian */
        *map->at++ = (uint8_t)(number >> shift);
    map->entries++;
}

static void add_words(struct map *map, const char *key, const char *text)
{
    if (text == NULL || !has_room(map, key, text))
        return;
    add_string(map, key);
    add_string(map, text);
    map->entries++;
}

static void add_truth(struct map *map, const char *key, bool truth)
{
    add_string(map, key);
    *map->at++ = truth ? 0xC3 : 0xC2;
    map->entries++;
}

static void add_facts(const struct pans_device *d, struct map *map)
{
    const struct pans_limits *l = &d->limits;
    add_truth(map, "simulated", l->simulated);
    add_value(map, "tick_hz", l->tick_hz);
    add_words(map, "mode", l->parallel ? "parallel" : "sequential");
    add_value(map, "channels", l->channels);
    add_value(map, "levels", l->levels);
    add_value(map, "pattern_memory", l->pattern_memory);
    add_value(map, "pattern_pixels", l->pattern_pixels);
    add_value(map, "slot_memory", l->slot_memory);
    add_value(map, "epoch", l->epoch);
    add_value(map, "tick", d->tick);
    add_value(map, "buffer_messages", l->buffer_messages);
    add_value(map, "gate_channels", l->gate_outputs);
    add_value(map, "exposed_schema", EXPOSED_SCHEMA);
    if (l->dwell_steps != 0) {
        add_value(map, "automaton_schema", AUTOMATON_SCHEMA);
        add_value(map, "automaton_states", l->automaton_states);
        add_value(map, "dwell_steps", l->dwell_steps);
    }
    add_words(map, "firmware", l->firmware);
    add_words(map, "serial", l->serial);
    for (size_t i = 0; i < l->n_facts; i++) {
        if (l->facts[i].text != NULL)
            add_words(map, l->facts[i].key, l->facts[i].text);
        else
            add_value(map, l->facts[i].key, l->facts[i].number);
    }
}

void send_welcome(struct pans_device *d, uint32_t session)
{
    uint8_t *at = d->scratch + HEADER_BYTES;
    put32(at, PANS_SCHEMA);
    put16(at + 4, PANS_PROTOCOL);
    put16(at + 6, 0);
    struct map map = {at + 11, d->scratch + sizeof d->scratch - CRC_BYTES, 0};
    add_facts(d, &map);
    at[8] = 0xDE; /* a map with 16 bits of length */
    at[9] = (uint8_t)(map.entries >> 8);
    at[10] = (uint8_t)map.entries;
    send(d, (uint32_t)(map.at - at), WELCOME, session);
}
