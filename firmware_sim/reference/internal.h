/* What the modules of the core share: the device's memory and the calls between them. */
#ifndef PANS_INTERNAL_H
#define PANS_INTERNAL_H

#include "bytes.h"
#include "frame.h"
#include "pans_device.h"

#define AUTOMATON_SCHEMA 0xD00A27FFu
#define NO_OBJECT 0xFFFFFFFFu
#define BLOCK_HEADER 36u
#define MAX_CYCLE_TICKS ((uint64_t)1 << 48)
#define LAST_TICK ((uint64_t)1 << 62)
#define MAX_LEASE_MS 3600000u
#define MAX_LEAVES 1048576u
#define MAX_STATES 0xFFFDu
#define TEXT_BYTES 120u
#define PONGS 8u
#define PONG_BYTES 48u
#define ANSWER_BYTES 4096u /* a WELCOME and some dozens of ACK and STATUS; what does not fit is lost, and the host asks again */

enum opcode {
    LOAD_PATTERN = 0x01, LOAD_PLAN, ARM, STOP, RESET, GATE, LOAD_MASKS, LOAD_STATES, SHOW,
};
enum reason { NO_REASON, COMPLETED, STOPPED, LEASE_EXPIRED, POWER_ON };

struct pattern {
    uint32_t whole, filled;
};

struct plan {
    bool complete, adaptive;
    uint8_t mode;
    uint16_t n_patterns, block_exposures;
    uint32_t n_slots, exposure_ticks, period_ticks, cycles_per_object;
    uint64_t cycle_ticks;
    uint32_t filled, adaptive_slots;
    uint64_t *start; /* of each slot within the cycle */
    uint16_t *pattern;
};

struct state_row {
    uint16_t pattern, dwell;
    uint32_t next[2]; /* without a click, after one */
};

struct automaton {
    bool begun, complete;
    uint16_t n_states, dwell_steps, filled, longest;
    uint32_t n_leaves, revision;
    struct state_row *row;
    uint16_t *depth; /* exposures of the longest walk up to and with a state; 0: not reached */
};

struct show {
    uint64_t exposure;
    uint16_t state;
    struct pans_light light;
};

struct shows {
    struct show *at;
    uint16_t count;
};

struct run {
    bool active, exposing, host_driven;
    uint64_t start_tick, cycles, end_tick;
    uint64_t cycle, cycle_tick, next_tick; /* next_tick: of the present exposure's end, or the next one's begin */
    uint64_t begun, ended;                 /* exposures since ARM */
    uint32_t slot, node;
    uint16_t stamp;
    uint64_t began_at; /* the present exposure, as late as the hardware was */
    uint64_t lease_tick;
};

struct block {
    uint8_t *body;
    uint32_t object;
    uint64_t tick, exposure;
    uint16_t count;
};

struct stream {
    struct ring ring;
    uint32_t limit, sequence, held, drops;
    struct block block;
};

struct pulse {
    uint64_t tick, end;
    uint16_t output;
    bool open;
};

struct gates {
    struct pulse *at;
    uint16_t count;
    uint64_t next_tick;
};

struct ack {
    uint32_t last, refused, mask;
    uint16_t status;
    char text[TEXT_BYTES];
    uint16_t text_bytes; /* of the latest refusal */
};

struct pong {
    uint32_t id;
    uint64_t host_ns, arrival;
};

enum sending { NONE, OF_PONGS, OF_ANSWERS, OF_STREAM, OF_FORGOTTEN };

struct pans_device {
    struct pans_limits limits;
    struct pans_hardware hw;
    struct pans_counters counters;
    uint64_t tick;
    uint32_t session; /* the host's nonce; 0 without one */
    enum pans_state state;
    enum reason reason;
    uint64_t status_tick;
    struct decoder decoder;
    struct ack ack;
    char why[TEXT_BYTES]; /* the present command is refused */
    uint16_t why_bytes;
    struct ring answers, pong_ring;
    struct pong pong[PONGS];
    uint8_t n_pongs;
    enum sending sending; /* whose frame has left in part */
    bool stream_was_last; /* the frame before was of the stream, and an answer waits */
    struct pattern *patterns;
    uint64_t held_pixels;
    uint32_t patterns_revision;
    struct plan plan;
    struct automaton automaton;
    struct shows shows;
    struct run run;
    struct stream stream;
    struct gates gates;
    uint8_t scratch[ANSWER_BYTES / 2]; /* one answer before it is framed */
    uint8_t *received, *staged;        /* of pans_turn, port_bytes each */
    size_t staged_from, staged_to;
};

/* answers.c */
void send_welcome(struct pans_device *d, uint32_t session);
void send_ack(struct pans_device *d);
void send_status(struct pans_device *d);
void take_ping(struct pans_device *d, const uint8_t *payload);
void frame_pong(struct pans_device *d);

/* Refuse the present command: its status, and why; with the number that was found and the one that is allowed. */
enum pans_status refuse(struct pans_device *d, enum pans_status status, const char *why);
enum pans_status refuse_number(struct pans_device *d, enum pans_status status, const char *what, uint64_t found, uint64_t allowed);

/* patterns.c, plan.c, walk.c: the bodies of commands */
void forget_patterns(struct pans_device *d);
enum pans_status load_pattern(struct pans_device *d, const uint8_t *body, uint32_t count);
enum pans_status load_masks(struct pans_device *d, const uint8_t *body, uint32_t count);
enum pans_status require_patterns(struct pans_device *d);
enum pans_status load_plan(struct pans_device *d, const uint8_t *body, uint32_t count);
uint16_t word_bytes(uint16_t channels);
uint64_t gap_after(const struct plan *plan, uint32_t slot);
void forget_states(struct pans_device *d);
enum pans_status load_states(struct pans_device *d, const uint8_t *body, uint32_t count);
enum pans_status take_show(struct pans_device *d, const uint8_t *body, uint32_t count);
struct pans_light light_now(struct pans_device *d, uint16_t *stamp);
void walk_on(struct pans_device *d, bool click);
struct pans_light light_of_state(const void *device, uint16_t number, uint32_t next[2]);

/* run.c */
enum pans_status arm(struct pans_device *d, const uint8_t *body, uint32_t count);
enum pans_status prepare(struct pans_device *d);
uint64_t run_next_tick(const struct pans_device *d);
void run_do_due(struct pans_device *d, uint64_t tick); /* begins and ends of exposures due up to `tick` */
void run_end(struct pans_device *d, enum pans_state state, enum reason reason);
void enter(struct pans_device *d, enum pans_state state, enum reason reason);
void renew_lease(struct pans_device *d, uint32_t lease_ms);

/* stream.c */
void stream_restart(struct pans_device *d);
uint8_t *stream_word(struct pans_device *d); /* where the bits of the next exposure of many channels belong */
void stream_add(struct pans_device *d, bool click, uint64_t exposure, uint32_t object);
void stream_close_block(struct pans_device *d);
void stream_mark(struct pans_device *d, uint32_t object, uint64_t exposure, uint64_t tick);
bool stream_may_send(const struct pans_device *d);

/* gate.c */
enum pans_status take_gate(struct pans_device *d, const uint8_t *body, uint32_t count);
void gates_do_due(struct pans_device *d);
void gates_close(struct pans_device *d);

#endif
