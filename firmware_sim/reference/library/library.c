/* The instrument as a library, for tests: no port and no clock, time and bytes are arguments. Not for threads. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../posix/posix.h"

/* Answer the request for light `request`: a line of text, at most `room` bytes. */
typedef void (*answer)(const char *request, size_t count, char *line, size_t room);

struct instrument {
    struct settings settings;
    struct bench bench;
    struct pans_device *device;
    answer ask;
    const char *words; /* settings that are still to be read; NULL after the last */
    char *request;
    size_t count, room;
};

static struct instrument *here; /* whose light or settings are asked for */

void die(const char *what, const char *detail)
{
    fprintf(stderr, "pans-reference: %s: %s\n", what, detail);
    abort();
}

void read_line(char *line, size_t room)
{
    if (here->words == NULL) {
        here->ask(here->request, here->count, line, room);
        here->count = 0;
        return;
    }
    size_t length = strcspn(here->words, "\n");
    snprintf(line, room, "%.*s", (int)length, here->words);
    here->words += length + (here->words[length] == '\n');
}

void write_all(const void *bytes, size_t count)
{
    if (here->count + count > here->room) {
        here->room = 2 * (here->count + count);
        here->request = realloc(here->request, here->room);
        if (here->request == NULL)
            die("no memory", "");
    }
    memcpy(here->request + here->count, bytes, count);
    here->count += count;
}

size_t port_read(struct port *port, uint8_t *bytes, size_t room)
{
    (void)port, (void)bytes, (void)room;
    return 0;
}

size_t port_write(struct port *port, const uint8_t *bytes, size_t count)
{
    (void)port, (void)bytes;
    return count;
}

uint64_t clock_tick(const struct clock *clock)
{
    return clock->offset_ticks;
}

struct instrument *instrument_open(const char *settings, answer ask, uint64_t tick)
{
    here = calloc(1, sizeof *here);
    if (here == NULL)
        die("no memory", "");
    here->words = settings;
    here->ask = ask;
    read_settings(&here->settings);
    here->words = NULL;
    here->device = switch_on(&here->settings, &here->bench, tick);
    return here;
}

void instrument_step(struct instrument *one, uint64_t tick, const uint8_t *data, size_t count)
{
    here = one;
    pans_step(one->device, tick, data, count);
}

size_t instrument_output(struct instrument *one, uint64_t tick, uint8_t *out, size_t room)
{
    here = one;
    return pans_output(one->device, tick, out, room);
}

uint64_t instrument_next_tick(const struct instrument *one)
{
    return pans_next_tick(one->device);
}

const struct pans_counters *instrument_counters(const struct instrument *one)
{
    return pans_counters_of(one->device);
}

void instrument_close(struct instrument *one)
{
    light_close(&one->bench.light);
    free(one->bench.memory);
    free(one->request);
    free(one);
}
