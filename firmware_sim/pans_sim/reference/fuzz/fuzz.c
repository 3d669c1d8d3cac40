/* Strange bytes and frames at the core: `fuzz SECONDS SEED`, built with address and undefined-behaviour sanitizers.
 *
 * The seconds are of processor time: on a busy machine, or when it is stopped, a run takes longer and does as much.
 * Random bytes, damaged frames, and frames with a right CRC whose numbers stand at the edges; time passes by jumps, the line takes any number of
 * bytes, and now and then a device begins anew with other limits. Everything that it sends must be whole frames with a right CRC, in time.
 * Ends with 1 and the seed when something is wrong, and prints what was done.
 */
#define _XOPEN_SOURCE 700
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "../bytes.h"
#include "../frame.h"
#include "../pans_device.h"

#define LARGEST_FRAME (MAX_PAYLOAD + HEADER_BYTES + CRC_BYTES)
#define SESSION 0x5EED
#define MOST_FACTS 9

static struct {
    uint64_t dice, tick, exposures, frames_in, frames_out, bytes_in, armed, blocks, devices;
    uint32_t last_id, sequence, drops; /* of the message that comes next, and of the block before */
    uint64_t exposure;
    uint64_t exposing;
    bool is_open[4], held, ended;
    struct pans_device *device; /* that the interrupt is of; NULL: none */
    uint8_t body[LARGEST_FRAME], frame[LARGEST_FRAME + LARGEST_FRAME / 254 + 2], heard[LARGEST_FRAME];
    struct decoder decoder;
    struct ring ring;
} here;

static void wrong(const char *what)
{
    printf("WRONG: %s\n", what);
    exit(1);
}

static uint64_t roll(uint64_t below)
{
    here.dice ^= here.dice << 13;
    here.dice ^= here.dice >> 7;
    here.dice ^= here.dice << 17;
    return below == 0 ? here.dice : here.dice % below;
}

/* A number of `bits` bits: small, at an edge, or anything. */
static uint64_t number(unsigned bits)
{
    static const uint64_t EDGES[] = {0, 1, 2, 3, 4, 7, 8, 100, 255, 1000, 0xFFFE, 0xFFFF, 0x10000, 0x7FFFFFFF, 0xFFFFFFFF, (uint64_t)1 << 48,
                                     (uint64_t)1 << 62, UINT64_MAX >> 1, UINT64_MAX};
    uint64_t mask = bits == 64 ? UINT64_MAX : ((uint64_t)1 << bits) - 1;
    uint64_t any = roll(3) == 0 ? roll(0) : EDGES[roll(sizeof EDGES / sizeof EDGES[0])];
    return any & mask;
}

/* -- hardware that does nothing but count -- */

/* The timer's interrupt, in half of the lives: between any two functions that the main loop calls, but never while it is held. */
static void interrupt(void)
{
    if (here.device == NULL || here.held || roll(3) == 0)
        return;
    here.held = true;
    while (pans_edge_tick(here.device) <= here.tick)
        pans_edge(here.device);
    here.held = false;
}

static void hw_hold(void *self, bool on)
{
    (void)self;
    if (here.held == on)
        wrong(on ? "held twice" : "released twice");
    if (on)
        interrupt();
    here.held = on;
    if (!on)
        interrupt();
}

static uint64_t hw_now(void *self)
{
    (void)self;
    return here.tick;
}

static size_t hw_read(void *self, uint8_t *bytes, size_t room)
{
    (void)self;
    interrupt();
    size_t count = (size_t)roll(room + 1);
    for (size_t i = 0; i < count; i++)
        bytes[i] = (uint8_t)roll(256);
    return count;
}

static size_t hw_write(void *self, const uint8_t *bytes, size_t count)
{
    (void)self, (void)bytes;
    interrupt();
    return (size_t)roll(count + 1); /* bytes of pans_turn are not looked at: they would have to be put in order with those of pans_output */
}

static void hw_store(void *self, const struct pans_pixels *pixels)
{
    volatile uint8_t *sink = self;
    interrupt();
    size_t bytes = pixels == NULL ? 0 : pixels->bits ? (pixels->count + 7u) / 8 : 2u * pixels->count;
    for (size_t i = 0; i < bytes; i++) /* touch all: they must be there */
        *sink = pixels->data[i];
}

static enum pans_status hw_prepare(void *self, const struct pans_task *task, const char **why)
{
    uint32_t next[2];
    (void)self;
    interrupt();
    for (uint32_t i = 0; i < task->n_states; i++)
        if (task->state(task->device, (uint16_t)i, next).pattern >= task->n_patterns || next[0] <= i)
            wrong("a state that should have been refused");
    *why = "no";
    return roll(50) == 0 ? PANS_RANGE : PANS_DONE;
}

static uint64_t hw_expose(void *self, const struct pans_exposure *exposure)
{
    (void)self;
    here.exposures++;
    if (exposure->tick > here.tick)
        wrong("an exposure before its time");
    here.exposing++;
    return exposure->tick;
}

static uint64_t hw_clicks(void *self, uint8_t *word, uint16_t bytes)
{
    (void)self;
    here.exposing--;
    here.ended = true;
    for (uint16_t i = 0; i < bytes; i++)
        word[i] = (uint8_t)roll(256);
    return here.tick;
}

static void hw_show(void *self, const struct pans_exposure *next)
{
    (void)self;
    if (here.exposing != 0 || next->light.ticks > next->ticks || next->light.dwell > next->light.dwell_steps)
        wrong("light that cannot be meant");
    if (next->light.ticks != (uint64_t)next->ticks * next->light.dwell / next->light.dwell_steps)
        wrong("a dwell of other ticks");
}

static void hw_dark(void *self)
{
    (void)self;
    here.exposing = 0;
}

static void hw_gate(void *self, uint16_t output, bool open, uint64_t tick)
{
    (void)self;
    if (tick > here.tick)
        wrong("a gate before its time");
    if (here.is_open[output] == open)
        wrong("a gate that is so already");
    here.is_open[output] = open;
}

static bool hw_mark(void *self, uint32_t object, int16_t *truth, float *photons)
{
    (void)self, (void)object;
    interrupt();
    *truth = 1;
    *photons = 0.5f;
    return roll(2) != 0;
}

/* -- frames -- */

static void send(struct pans_device *device, size_t count)
{
    here.bytes_in += count;
    pans_step(device, here.tick, here.frame, count);
}

static void send_frame(struct pans_device *device, enum message type, uint32_t payload_bytes)
{
    bool ended;
    uint32_t session = roll(40) == 0 ? (uint32_t)number(32) : SESSION;
    ring_init(&here.ring, here.frame, sizeof here.frame);
    if (!ring_put_frame(&here.ring, here.body, HEADER_BYTES + payload_bytes, type, session))
        return;
    uint32_t count = ring_take(&here.ring, here.frame, sizeof here.frame, &ended);
    if (roll(30) == 0)
        here.frame[roll(count)] ^= (uint8_t)(1u << roll(8));
    here.frames_in++;
    send(device, count);
}

/* Fields from a word of letters: B, H, I, Q as in the protocol's notation; capital letters take a number from the list. */
static uint32_t fill(uint8_t *at, const char *letters, const uint64_t *numbers)
{
    uint8_t *start = at;
    for (; *letters != '\0'; letters++, numbers++) {
        uint64_t value = roll(12) == 0 ? number(64) : *numbers;
        unsigned bytes = *letters == 'B' ? 1 : *letters == 'H' ? 2 : *letters == 'I' ? 4 : 8;
        for (unsigned i = 0; i < bytes; i++)
            at[i] = (uint8_t)(value >> 8 * i);
        at += bytes;
    }
    return (uint32_t)(at - start);
}

static uint32_t plan_body(uint8_t *at, uint8_t mode)
{
    uint64_t slots = 1 + roll(6), period = 20 + roll(5), shown = roll(3);
    uint32_t count = fill(at, "BBHIIIIQHHI", (uint64_t[]){mode, 0, 3, slots, 0, 10, period, period * slots + roll(2) * 7, 1 + roll(4), 0, 1 + roll(3)});
    for (uint64_t i = 0; i < slots; i++) {
        uint64_t pattern = i == 0 ? 0xFFFF : shown == 0 ? 0xFFFE : i % 3;
        count += fill(at + count, "QHH", (uint64_t[]){i * period, pattern, pattern == 0xFFFF ? 0xFFFF : 0});
    }
    return count;
}

static uint32_t states_body(uint8_t *at)
{
    uint32_t n = 1 + (uint32_t)roll(4), count = fill(at, "HHHHI", (uint64_t[]){n, 0, 4, 0, 5});
    for (uint32_t i = 0; i < n; i++)
        count += fill(at + count, "HHII", (uint64_t[]){roll(3), 1 + roll(4), i + 1 + roll(2), i + 1 + roll(3)});
    return count;
}

static uint32_t command_body(uint8_t *at, uint8_t opcode, uint8_t mode)
{
    uint32_t count = 0;
    switch (opcode) {
    case 1:
        return fill(at, "HHIIHHHH", (uint64_t[]){roll(3), 0, 0, 4, 1, 0, 1, 0});
    case 2:
        return plan_body(at, mode);
    case 3:
        return fill(at, "QQII", (uint64_t[]){here.tick + 1 + roll(300), roll(2) * (1 + roll(40)), 1 + roll(2000), 0});
    case 6:
        return fill(at, "QIHH", (uint64_t[]){here.tick + roll(3000), roll(500), roll(4), 0});
    case 7:
        return fill(at, "HHIIIBBB", (uint64_t[]){0, 3, 0, 4, 4, 1, 2, 3});
    case 8:
        return states_body(at);
    case 9:
        return fill(at, "QHHHH", (uint64_t[]){roll(200), roll(9), roll(3), 1 + roll(4), 4});
    default:
        for (count = 0; count < roll(3) * roll(20); count++)
            at[count] = (uint8_t)roll(256);
        return count;
    }
}

static void send_command(struct pans_device *device, uint8_t opcode, uint8_t mode)
{
    uint8_t *at = here.body + HEADER_BYTES;
    put32(at, roll(25) == 0 ? (uint32_t)number(32) : here.last_id + 1);
    put32(at + 4, opcode);
    uint32_t count = 8 + command_body(at + 8, opcode, mode);
    if (roll(30) == 0)
        count = count - 1 + (uint32_t)roll(3);
    send_frame(device, COMMAND, count);
}

static void send_other(struct pans_device *device)
{
    uint8_t *at = here.body + HEADER_BYTES;
    switch (roll(12)) {
    case 0:
        if (roll(8) != 0)
            return;
        send_frame(device, HELLO, fill(at, "IHH", (uint64_t[]){PANS_SCHEMA, PANS_PROTOCOL, 0}));
        return;
    case 1:
        send_frame(device, (enum message)roll(256), (uint32_t)roll(200));
        return;
    case 2:
        for (size_t i = 0; i < 3000; i++)
            here.frame[i] = (uint8_t)(roll(3) == 0 ? 0 : roll(4) == 0 ? 255 : roll(256));
        send(device, (size_t)roll(3000));
        return;
    case 3:
        if (roll(60) != 0)
            return;
        for (int i = 0; i < 3; i++) { /* without an end, longer than any frame */
            memset(here.frame, 1 + (int)roll(255), sizeof here.frame);
            send(device, sizeof here.frame);
        }
        return;
    case 4:
    case 5:
    case 6:
        send_frame(device, PING, fill(at, "IQ", (uint64_t[]){number(32), number(64)}));
        return;
    default:
        send_frame(device, GRANT, fill(at, "II", (uint64_t[]){roll(4000), roll(3000)}));
    }
}

/* -- what comes back -- */

static void judge(uint32_t count)
{
    const uint8_t *payload = here.heard + HEADER_BYTES;
    here.frames_out++;
    if (here.heard[1] != 0 || get16(here.heard + 2) != 0)
        wrong("flags or reserved bytes that are not 0");
    switch ((enum message)here.heard[0]) {
    case ACK:
        if (count != HEADER_BYTES + 16u + get16(payload + 14) + CRC_BYTES || get16(payload + 12) > 5 || get32(payload + 4) > get32(payload))
            wrong("an ACK that cannot be meant");
        here.last_id = get32(payload);
        break;
    case STATUS:
        if (payload[0] > 3 || payload[1] > 5 || get64(payload + 12) > here.tick)
            wrong("a STATUS that cannot be meant");
        here.armed += payload[0] == PANS_ARMED;
        break;
    case EXPOSED:
        if (get32(payload) == 0 || (int32_t)get32(payload + 4) < 0 || get64(payload + 12) > here.exposures || get64(payload + 20) > here.exposures)
            wrong("an EXPOSED that cannot be meant");
        break;
    case PONG:
        if (get64(payload + 12) > get64(payload + 20) || get64(payload + 20) > here.tick)
            wrong("a PONG that cannot be meant");
        break;
    case CLICKS:
    case FRAMES:
        here.blocks++;
        if (get16(payload + 28) == 0 || get64(payload + 8) > here.tick)
            wrong("a block that cannot be meant");
        if (get32(payload) == here.sequence && get64(payload + 16) != here.exposure + (get32(payload + 4) - here.drops))
            wrong("an exposure that is neither in a block nor dropped");
        here.sequence = get32(payload) + 1;
        here.drops = get32(payload + 4);
        here.exposure = get64(payload + 16) + get16(payload + 28);
        break;
    case WELCOME:
        here.last_id = roll(2) == 0 ? 0 : here.last_id;
        break;
    case MARK:
        if (get32(payload) == 0)
            here.drops = 0, here.exposure = 0, here.sequence = 0;
        here.sequence += get32(payload) == here.sequence;
        break;
    default:
        wrong("a message of no known type");
    }
}

static void listen(struct pans_device *device)
{
    static uint8_t out[8192];
    size_t count = pans_output(device, here.tick, out, (size_t)roll(roll(4) == 0 ? 20 : sizeof out));
    for (size_t i = 0; i < count; i++) {
        uint32_t bytes;
        enum arrival arrival = decoder_take(&here.decoder, out[i], &bytes);
        if (arrival == DAMAGED)
            wrong("a damaged frame from the device");
        if (arrival == FRAME)
            judge(bytes);
    }
}

/* Facts of WELCOME besides: as many as there is room for are told. */
static const struct pans_fact *any_facts(void)
{
    static char text[600];
    static struct pans_fact facts[MOST_FACTS];
    memset(text, 'x', sizeof text);
    text[roll(sizeof text)] = '\0';
    text[sizeof text - 1] = '\0';
    for (size_t i = 0; i < MOST_FACTS; i++)
        facts[i] = (struct pans_fact){text + roll(sizeof text), roll(2) ? text : NULL, number(64)};
    return facts;
}

static struct pans_limits any_limits(void)
{
    bool parallel = roll(3) == 0;
    struct pans_limits limits = {
        .tick_hz = 1000 + roll(3) * 1000000, .parallel = parallel, .channels = (uint16_t)(parallel ? 1 + roll(40) : 1),
        .levels = 2 + (uint32_t)roll(3), .pattern_memory = (uint16_t)(1 + roll(6)), .pattern_pixels = 1 + (uint32_t)roll(200),
        .pixel_memory = roll(600), .slot_memory = 1 + (uint32_t)roll(9), .automaton_states = (uint16_t)(parallel ? 0 : roll(8)),
        .dwell_steps = (uint16_t)(parallel ? 0 : roll(3) * 4), .show_memory = 64, .exposure_min_ticks = 1, .exposure_max_ticks = 100,
        .readout_ticks = (uint32_t)roll(8), .pattern_ticks = (uint32_t)roll(20), .turn_ticks = (uint32_t)roll(12),
        .buffer_messages = 1 + (uint32_t)roll(20), .block_bytes = 39 + (uint32_t)roll(300), .payload_bytes = roll(2) ? 65536 : 64 + (uint32_t)roll(900),
        .port_bytes = 1 + (uint32_t)roll(300), .pending_exposures = (uint16_t)(2 + roll(6)), .gate_outputs = 4, .gate_pulses = (uint16_t)(1 + roll(6)), .epoch = 1, .firmware = "fuzz", .serial = "0",
    };
    limits.facts = any_facts();
    limits.n_facts = roll(MOST_FACTS + 1);
    limits.buffer_bytes = limits.block_bytes + limits.block_bytes / 254 + 32 + (uint32_t)roll(2000);
    return limits;
}

/* One device from power-on, for some thousand turns. */
static void one_life(void)
{
    struct pans_limits limits = any_limits();
    size_t bytes = pans_memory_bytes(&limits);
    uint8_t sink, *memory = malloc(bytes);
    const struct pans_hardware hardware = {
        .self = &sink, .now = hw_now, .read = hw_read, .write = hw_write, .store = hw_store, .prepare = hw_prepare, .dark = hw_dark, .mark = hw_mark,
        .hold = roll(2) ? hw_hold : NULL, .show = hw_show, .expose = hw_expose, .clicks = hw_clicks, .gate = hw_gate,
    };
    here.device = NULL;
    struct pans_device *device = pans_start(&limits, &hardware, memory, bytes, here.tick);
    if (device == NULL || pans_start(&limits, &hardware, memory, bytes - 8, here.tick) != NULL)
        wrong("memory that does not suffice, or that is not looked at");
    here.devices++;
    device = pans_start(&limits, &hardware, memory, bytes, here.tick);
    here.device = hardware.hold == NULL ? NULL : device;
    here.last_id = 0;
    here.exposing = 0;
    memset(here.is_open, 0, sizeof here.is_open);
    decoder_init(&here.decoder, here.heard, sizeof here.heard);
    memset(here.body, 0, sizeof here.body);
    send_frame(device, HELLO, fill(here.body + HEADER_BYTES, "IHH", (uint64_t[]){PANS_SCHEMA, PANS_PROTOCOL, 0}));
    for (int turn = 0, deaf = 0; turn < 3000; turn++) {
        static const uint8_t UPLOADS[] = {5, 7, 1, 2, 8, 3, 9, 6, 9, 4};
        uint8_t opcode = roll(3) == 0 ? (uint8_t)roll(12) : UPLOADS[(turn / 2) % 10];
        if (roll(3) != 0)
            send_command(device, opcode, limits.parallel);
        else
            send_other(device);
        here.tick += roll(4) == 0 ? roll(400) : roll(3);
        if (deaf == 0)
            deaf = roll(1500) == 0 ? (int)roll(300) : 0;
        else
            deaf--; /* for so long nobody takes what it says */
        if (deaf == 0)
            listen(device);
        here.ended = false;
        interrupt();
        if (here.ended && here.device != NULL && pans_next_tick(device) > here.tick)
            wrong("an exposure has ended, and nobody is called");
        if (pans_next_tick(device) < here.tick && roll(2) == 0)
            pans_step(device, here.tick, NULL, 0);
        if (here.exposing > 1)
            wrong("two exposures at once");
    }
    for (int turn = 0; turn < 20; turn++, here.tick += roll(50))
        pans_turn(device);
    pans_step(device, here.tick, (const uint8_t *)"", 1);
    free(memory);
}

int main(int count, char **words)
{
    double seconds = count > 1 ? strtod(words[1], NULL) : 5;
    struct timespec used; /* of this process: it begins at 0 */
    here.dice = (count > 2 ? strtoull(words[2], NULL, 10) : 1) * 0x9E3779B97F4A7C15u | 1;
    do {
        one_life();
        if (clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &used) != 0)
            wrong("no clock of processor time");
    } while ((double)used.tv_sec + (double)used.tv_nsec * 1e-9 < seconds);
    printf("%llu bytes, %llu frames in, %llu out, %llu armed, %llu exposures, %llu blocks, %llu devices, %lld seconds\n",
           (unsigned long long)here.bytes_in, (unsigned long long)here.frames_in, (unsigned long long)here.frames_out,
           (unsigned long long)here.armed, (unsigned long long)here.exposures, (unsigned long long)here.blocks,
           (unsigned long long)here.devices, (long long)used.tv_sec);
    return 0;
}
