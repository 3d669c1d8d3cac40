/* The reference instrument: a device that speaks version 1 of the instrument protocol (docs/reference/protocol.md), in C99.
 *
 * The core is bytes in, bytes out, with ticks as arguments. It reads no clock, opens no port, needs no operating system and allocates
 * nothing: all memory is one block that the caller hands over at start. What touches the world is in the hardware functions below.
 *
 * What must happen at a tick is apart from what may wait. `pans_edge` begins or ends an exposure or switches a gate: no framing, no division,
 * no memory but its own; a timer interrupt may call it. All else (bytes, commands, blocks, leases) is the main loop's.
 */
#ifndef PANS_DEVICE_H
#define PANS_DEVICE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define PANS_DARK 0xFFFFu     /* a slot, or a stamp: no light */
#define PANS_ADAPTIVE 0xFFFEu /* a slot: the clicks before choose the pattern */
#define PANS_NEVER UINT64_MAX

enum pans_state { PANS_IDLE, PANS_ARMED, PANS_RUNNING, PANS_SAFE };
enum pans_status { PANS_DONE, PANS_UNKNOWN, PANS_MALFORMED, PANS_RANGE, PANS_WRONG_STATE, PANS_LATE };

/* One more key of WELCOME's map: text, or a number where `text` is NULL. */
struct pans_fact {
    const char *key;
    const char *text;
    uint64_t number;
};

/* What the instrument is and what it can hold; it decides how much memory the core needs. */
struct pans_limits {
    uint64_t tick_hz;
    bool parallel; /* all channels at once; else pattern after pattern before one detector */
    bool simulated;
    uint16_t channels;
    uint32_t levels; /* of the projector, 0 (dark) counted */
    uint16_t pattern_memory;
    uint32_t pattern_pixels;
    uint64_t pixel_memory; /* pixels of all patterns together */
    uint32_t slot_memory;
    uint16_t automaton_states; /* 0: the host names each state */
    uint16_t dwell_steps;      /* 0: the device knows no automata */
    uint16_t show_memory;      /* exposures that the host may name ahead: at least 64 where automata are known */
    uint32_t exposure_min_ticks, exposure_max_ticks;
    uint32_t readout_ticks; /* least time from the end of an exposure to the next one */
    uint32_t pattern_ticks; /* least time between two changes of the pattern */
    uint32_t turn_ticks;    /* least time from the end of an exposure to the pattern that its click chose */
    uint32_t buffer_messages, buffer_bytes; /* of the stream */
    uint32_t block_bytes;                   /* longest payload of a block, 36 to 65536 */
    uint32_t payload_bytes;                 /* longest payload that is received: 65536, or less by a board that says so */
    uint32_t port_bytes;                    /* read or written at once by pans_turn */
    uint16_t pending_exposures;             /* that may end before the main loop takes them up: at least 2 */
    uint32_t lead_ticks;                    /* by how much pans_turn is ahead of an edge; 0: at its tick, or later */
    uint16_t gate_outputs, gate_pulses;     /* outputs; pulses that may be pending */
    uint64_t epoch;                         /* another one whenever the tick counter has restarted */
    const char *firmware, *serial;
    const struct pans_fact *facts; /* more of them */
    size_t n_facts;
};

/* Pixels on their way to the projector: 16-bit levels, or one bit each (lowest bit first) where `bits` is set. */
struct pans_pixels {
    uint16_t pattern;
    uint32_t first, count, whole; /* pixels here start at `first` of `whole` */
    bool bits;
    const uint8_t *data;
};

struct pans_light {
    uint16_t pattern; /* PANS_DARK: none */
    uint16_t dwell, dwell_steps; /* the light is on for dwell / dwell_steps of the exposure, from its start on */
    uint32_t ticks;              /* the same in ticks */
};

struct pans_exposure {
    uint64_t tick;   /* at which it shall begin */
    uint64_t number; /* since ARM */
    uint32_t object; /* number of the visit since ARM */
    uint32_t ticks;  /* how long the detector is open */
    uint16_t state;  /* of a device-driven walk; PANS_DARK: none */
    struct pans_light light;
};

/* A measurement that the hardware is to make itself ready for. */
struct pans_task {
    uint32_t patterns_revision; /* another number whenever a pixel has changed */
    uint32_t states_revision;
    uint16_t n_patterns;
    uint16_t n_states; /* 0: no automaton that the device follows */
    bool adaptive;
    uint32_t exposure_ticks;
    struct pans_light (*state)(const void *device, uint16_t number, uint32_t next[2]); /* what a state shows, and where it leads */
    const void *device;
};

/* The functions of the hardware. `self` is whatever the board needs; none of them may wait for the host. */
struct pans_hardware {
    void *self;
    /* From the main loop. */
    uint64_t (*now)(void *self);                                         /* clock: ticks, never going back */
    size_t (*read)(void *self, uint8_t *bytes, size_t room);             /* port: what has arrived, 0 without */
    size_t (*write)(void *self, const uint8_t *bytes, size_t count);     /* port: how many it took */
    void (*store)(void *self, const struct pans_pixels *pixels);         /* projector: in order; NULL: forget all */
    enum pans_status (*prepare)(void *self, const struct pans_task *task, const char **why); /* all: DONE, or why not */
    void (*dark)(void *self); /* projector, detector: no light and no exposure, at once; the run is over */
    bool (*mark)(void *self, uint32_t object, int16_t *truth, float *photons); /* what a simulator knows; else false */
    void (*hold)(void *self, bool on); /* keep pans_edge from being called while `on`; NULL: pans_step and pans_turn call it themselves */
    /* From pans_edge, which `hold` keeps away; `show` also from the main loop, held. */
    void (*show)(void *self, const struct pans_exposure *next);           /* projector: what comes next, as soon as it is known; may be NULL */
    uint64_t (*expose)(void *self, const struct pans_exposure *exposure); /* wait for its tick, let there be light, open: when it began */
    uint64_t (*clicks)(void *self, uint8_t *word, uint16_t bytes); /* wait for its end, close, read the bits: the tick at which it ended */
    void (*gate)(void *self, uint16_t output, bool open, uint64_t tick);  /* wait for the tick, switch */
};

struct pans_counters {
    uint32_t frames, damaged, foreign, malformed, unknown, refused, repeated, out_of_order, lease_expiries;
    uint32_t dropped_messages, answers_lost;
};

struct pans_device;

/* How many bytes the device needs; 0 when the limits cannot be meant. */
size_t pans_memory_bytes(const struct pans_limits *limits);

/* Switch the device on at `tick`, in `memory` (aligned to 8 bytes) that it keeps; NULL when that does not suffice. The facts stay with the
 * caller. */
struct pans_device *pans_start(const struct pans_limits *limits, const struct pans_hardware *hardware, void *memory, size_t bytes,
                               uint64_t tick);

/* The tick of the next edge: an exposure begins or ends, a gate opens or closes. PANS_NEVER: none. */
uint64_t pans_edge_tick(const struct pans_device *device);

/* Do that. To be called ahead of its tick, for which the hardware functions wait: by more than the interrupt and the longest `hold` take. */
void pans_edge(struct pans_device *device);

/* Do what is due up to `tick`, then digest bytes that have come by then. Ticks never go back, nor ahead of the clock: leases are judged by
 * them. */
void pans_step(struct pans_device *device, uint64_t tick, const uint8_t *data, size_t count);

/* Copy what may be sent at `tick`, at most `room` bytes; 0 when there is nothing. What is copied counts as sent. */
size_t pans_output(struct pans_device *device, uint64_t tick, uint8_t *out, size_t room);

/* The tick at which the device does something by itself; PANS_NEVER when it waits for the host. */
uint64_t pans_next_tick(const struct pans_device *device);

/* One turn of the usual main loop: read, step, write. Returns whether there was anything to read or write. */
bool pans_turn(struct pans_device *device);

/* Whether the port has not taken all that pans_turn offered it. */
bool pans_has_output(const struct pans_device *device);

enum pans_state pans_state_of(const struct pans_device *device);
const struct pans_counters *pans_counters_of(const struct pans_device *device);

#endif
