/* The reference instrument on a POSIX system, as a simulator: a port, a clock, and light that the Python simulator has computed.
 *
 * Settings come on standard input, one a line, before `start`. Requests for light leave on standard output, whose first line is the device's
 * URL; the answers come on standard input. When that ends, so does the program.
 */
#ifndef PANS_POSIX_H
#define PANS_POSIX_H

#include <stdint.h>
#include <sys/types.h>

#include "../pans_device.h"

#define NAME_BYTES 512

struct settings {
    struct pans_limits limits;
    char listen[NAME_BYTES], firmware[NAME_BYTES], serial[NAME_BYTES], profile[NAME_BYTES], scene[NAME_BYTES];
    uint64_t offset_ticks, drift; /* parts per billion, 10^9 added */
    uint64_t objects, seed, awake;
    struct pans_fact facts[4];
};

struct clock {
    uint64_t tick_hz, offset_ticks, rate; /* rate: 10^9 + drift in parts per billion */
};

struct port {
    int client, listener, other_end; /* descriptors, -1 without */
    char url[NAME_BYTES];
};

/* The light of a measurement, as the simulator wrote it to a file: see light.c. */
struct light {
    const uint64_t *header, *limit, *primed;
    const double *mean, *photons, *counted;
    const int64_t *truth;
    void *mapped;
    size_t mapped_bytes;
    uint64_t draws; /* exposures since power-on: each has its own random number */
    uint64_t key[6]; /* of the measurement that the file is of */
    struct pans_exposure now;
    uint64_t draw_now;
    uint8_t *before, *present; /* clicks of the exposure before, one byte a channel */
    char why[NAME_BYTES];
};

struct bench {
    struct clock clock;
    struct port port;
    struct light light;
    void *memory;
};

void read_settings(struct settings *settings);
struct pans_device *switch_on(struct settings *settings, struct bench *bench, uint64_t tick);
void die(const char *what, const char *detail);

void open_port(struct port *port, const char *listen);
size_t port_read(struct port *port, uint8_t *bytes, size_t room);
size_t port_write(struct port *port, const uint8_t *bytes, size_t count);
void port_wait(const struct port *port, uint64_t most_ns, int wants_to_write);

uint64_t clock_tick(const struct clock *clock);
uint64_t clock_ns_until(const struct clock *clock, uint64_t tick);

void light_init(struct light *light, uint16_t channels);
void light_close(struct light *light);
void light_store(const struct pans_pixels *pixels);
enum pans_status light_prepare(struct light *light, const struct pans_task *task, const char **why);
void light_expose(struct light *light, const struct pans_exposure *exposure);
void light_clicks(struct light *light, uint8_t *word);
bool light_mark(const struct light *light, uint32_t object, int16_t *truth, float *photons);

/* Read a line from standard input, without its end; ends the program when there is none. */
void read_line(char *line, size_t room);
void write_all(const void *bytes, size_t count);

#endif
