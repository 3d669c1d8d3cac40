/* A host in a can, for a test that is the same to the tick every time: HELLO, eight masks, a plan of 32 adaptive slots and a dark one, a chain of
 * states, ARM for 100 cycles; then a PING and a gate pulse every 3 ms. All that the device answers goes into a hash. The clicks mean nothing. */
#include <string.h>

#include "../internal.h"
#include "board.h"

enum { CYCLES = 100, SLOTS = 33, EXPOSURE = 3895, GAP = 1100, PERIOD = EXPOSURE + GAP, PING_TICKS = 75000 }; /* 155.8 us, 44 us, 3 ms */

static uint8_t line[8192], body[4096];
static struct ring ring;
static uint32_t id, hash = 2166136261u, answered;
static uint64_t next_ping, start;

static void add(enum message type, uint32_t count)
{
    ring_put_frame(&ring, body, HEADER_BYTES + count, type, 0x11223344u);
}

static uint8_t *command_of(uint8_t opcode)
{
    uint8_t *at = body + HEADER_BYTES;
    put32(at, ++id);
    put32(at + 4, opcode);
    return at + 8;
}

static void load(void)
{
    uint8_t *at = command_of(LOAD_MASKS);
    put32(at, 8u << 16), put32(at + 4, 0), put32(at + 8, 784), put32(at + 12, 784);
    for (uint32_t i = 0; i < 8 * 98; i++)
        at[16 + i] = (uint8_t)(i * 37u >> 2);
    add(COMMAND, 8 + 16 + 8 * 98);
    at = command_of(LOAD_PLAN);
    put16(at, 0), put16(at + 2, 8), put32(at + 4, SLOTS), put32(at + 8, 0), put32(at + 12, EXPOSURE), put32(at + 16, PERIOD);
    put64(at + 20, (uint64_t)SLOTS * PERIOD), put16(at + 28, SLOTS), put16(at + 30, 0), put32(at + 32, 1);
    for (uint32_t i = 0; i < SLOTS; i++) {
        uint8_t *slot = at + 36 + 12 * i;
        put64(slot, (uint64_t)i * PERIOD), put16(slot + 8, i == 0 ? PANS_DARK : PANS_ADAPTIVE);
        put16(slot + 10, i == 0 ? 0xFFFFu : (uint16_t)(i - 1));
    }
    add(COMMAND, 8 + 36 + 12 * SLOTS);
    at = command_of(LOAD_STATES);
    put16(at, SLOTS - 1), put16(at + 2, 0), put16(at + 4, 1000), put16(at + 6, 0), put32(at + 8, 2);
    for (uint32_t i = 0; i < SLOTS - 1; i++) {
        uint8_t *state = at + 12 + 12 * i;
        put16(state, (uint16_t)(i % 8)), put16(state + 2, 700), put32(state + 4, i + 1), put32(state + 8, i + 1);
    }
    add(COMMAND, 8 + 12 + 12 * (SLOTS - 1));
}

static void open_and_arm(void)
{
    start = tick() + TICK_HZ / 10;
    ring_init(&ring, line, sizeof line);
    put32(body + HEADER_BYTES, PANS_SCHEMA), put32(body + HEADER_BYTES + 4, PANS_PROTOCOL);
    add(HELLO, 8);
    load();
    put32(body + HEADER_BYTES, 1000000), put32(body + HEADER_BYTES + 4, 60000);
    add(GRANT, 8);
    uint8_t *at = command_of(ARM);
    put64(at, start), put64(at + 8, CYCLES), put32(at + 16, 60000), put32(at + 20, 0);
    add(COMMAND, 8 + 24);
    next_ping = start;
}

/* A PING, and on every second one a gate that opens 2 ms ahead, for 1 ms. */
static void keep_talking(void)
{
    uint8_t *at = body + HEADER_BYTES;
    put32(at, (uint32_t)next_ping), put64(at + 4, next_ping);
    add(PING, 12);
    next_ping += PING_TICKS;
    at = command_of(GATE);
    put64(at, tick() + 50000), put32(at + 8, 25000), put32(at + 12, id & 3u);
    add(COMMAND, 8 + 16);
}

size_t line_read(uint8_t *bytes, size_t room)
{
    bool ended;
    if (start == 0)
        open_and_arm();
    if (tick() >= next_ping)
        keep_talking();
    return ring.used == 0 ? 0 : ring_take(&ring, bytes, room, &ended);
}

size_t line_write(const uint8_t *bytes, size_t count)
{
    for (size_t i = 0; i < count; i++)
        hash = (hash ^ bytes[i]) * 16777619u; /* Fowler, Noll and Vo */
    answered += (uint32_t)count;
    return count;
}

void line_wait(uint64_t next)
{
    (void)next;
}

void light_init(void)
{
}

void light_store(const struct pans_pixels *pixels)
{
    (void)pixels;
}

bool light_click(const struct pans_exposure *exposure)
{
    return exposure->number * 2654435761u >> 31 & 1u;
}

int16_t light_class(uint32_t object)
{
    (void)object;
    return -1;
}

uint32_t light_objects(void)
{
    return 0;
}

void line_report(void)
{
    board_report();
    log_number("answered_bytes", answered);
    log_number("answers_hash", hash);
    leave();
}
