/* What the modules of the core share: the device's memory and the calls between them. */
#ifndef PANS_INTERNAL_H
#define PANS_INTERNAL_H

#include "bytes.h"
#include "frame.h"
#include "pans_device.h"

#define AUTOMATON_SCHEMA 0xD00A27FFu
#define EXPOSED_SCHEMA 0x9D499DC7u
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
    uint64_t step_ticks; /* of light in one dwell step, times 2^32, rounded up: dwell by dwell exact, without a division */
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

/* Which exposure of a run: counted on, never divided. */
struct place {
    uint64_t number; /* since ARM */
    uint64_t cycle_tick;
    uint32_t slot, cycle_here, object; /* cycles of this object's visit that are over */
};

/* An exposure that has ended, on its way to the main loop; its bits stand behind it. */
struct ended {
    uint64_t began;
    uint32_t length; /* ticks */
    uint32_t missed; /* exposures right before it that found no room */
    uint16_t stamp;
};

/* What pans_edge works with. While `on` the main loop changes it under `hold` only; the entries in use are the main loop's. */
struct edges {
    bool on, exposing;
    uint64_t tick; /* at which the exposure under way ends, or the next one begins; PANS_NEVER after the last */
    uint64_t end_tick;
    struct place place; /* of the exposure under way, or of the next one */
    struct pans_exposure exposure;
    uint64_t began;
    uint32_t node;
    uint16_t stamp, word_bytes;
    uint8_t *ended; /* `size` places and one to spare, `stride` bytes each */
    uint32_t stride;
    uint16_t size, first, used;
    uint32_t missed;
};

struct run {
    bool active, host_driven, marked; /* the present object has its MARK */
    uint64_t start_tick, cycles, end_tick, lease_tick;
    struct place place; /* of the first exposure that the stream does not have */
};

/* How far exposures were from the plan: the worst since the latest EXPOSED. */
struct evidence {
    uint32_t exposures;
    int32_t start, length; /* ticks */
    uint64_t start_at, length_at;
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
    uint16_t *open; /* pulses that hold each output open */
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
    struct edges edges;
    struct evidence evidence;
    struct stream stream;
    struct gates gates;
    uint8_t scratch[ANSWER_BYTES / 2]; /* one answer before it is framed */
    uint8_t *received, *staged;        /* of pans_turn, port_bytes each */
    size_t staged_from, staged_to;
};

/* answers.c */
void send_welcome(struct pans_device *d, uint32_t session);
void send_ack(struct pans_device *d);
void send_status(struct pans_device *d); /* and EXPOSED before it */
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
const struct show *find_show(const struct shows *shows, uint64_t exposure);
struct pans_light light_of_state(const void *device, uint16_t number, uint32_t next[2]);

/* edge.c */
void hold(struct pans_device *d, bool on);
void place_next(const struct plan *plan, struct place *place);
void edges_start(struct pans_device *d); /* under hold: from the run's first exposure on */
void edges_named(struct pans_device *d); /* under hold: the host has named a state */

/* run.c */
enum pans_status arm(struct pans_device *d, const uint8_t *body, uint32_t count);
enum pans_status prepare(struct pans_device *d);
void run_collect(struct pans_device *d); /* exposures that have begun or ended go to the stream */
bool run_is_over(struct pans_device *d); /* every exposure has ended and been collected */
uint64_t run_begun(struct pans_device *d);
void run_end(struct pans_device *d, enum pans_state state, enum reason reason);
void enter(struct pans_device *d, enum pans_state state, enum reason reason);
void renew_lease(struct pans_device *d, uint32_t lease_ms);

/* stream.c */
void stream_restart(struct pans_device *d);
void stream_add(struct pans_device *d, const struct ended *ended); /* the exposure at run.place */
void stream_close_block(struct pans_device *d);
void stream_mark(struct pans_device *d, uint32_t object, uint64_t exposure, uint64_t tick);
bool stream_may_send(const struct pans_device *d);

/* gate.c */
enum pans_status take_gate(struct pans_device *d, const uint8_t *body, uint32_t count);
void gates_switch(struct pans_device *d); /* from pans_edge: what is due at gates.next_tick */
void gates_close(struct pans_device *d);

#endif
