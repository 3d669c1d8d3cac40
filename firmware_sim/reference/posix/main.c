/* The program: an instrument behind its port, until standard input ends. */
#define _XOPEN_SOURCE 700
#include <errno.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "posix.h"

#define LONGEST_WAIT_NS 250000000u
#define FIFO_PRIORITY 20 /* above the host's loop: light does not wait for a computer */

void die(const char *what, const char *detail)
{
    fprintf(stderr, "pans-reference: %s: %s\n", what, detail);
    exit(2);
}

void read_line(char *line, size_t room)
{
    size_t count = 0;
    char one;
    for (;;) {
        ssize_t got = read(STDIN_FILENO, &one, 1);
        if (got == 0)
            exit(0);
        if (got == 1 && one == '\n')
            break;
        if (got == 1 && count + 1 < room)
            line[count++] = one;
    }
    line[count] = '\0';
}

void write_all(const void *bytes, size_t count)
{
    const char *at = bytes;
    while (count != 0) {
        ssize_t took = write(STDOUT_FILENO, at, count);
        if (took < 0 && errno == EINTR)
            continue;
        if (took < 0)
            exit(0);
        at += took;
        count -= (size_t)took;
    }
}

int main(void)
{
    static struct settings settings;
    static struct bench bench;
    read_settings(&settings);
    bench.clock = (struct clock){settings.limits.tick_hz, settings.offset_ticks, settings.drift};
    open_port(&bench.port, settings.listen);
    struct pans_device *device = switch_on(&settings, &bench, clock_tick(&bench.clock));
    sched_setscheduler(0, SCHED_FIFO, &(struct sched_param){.sched_priority = FIFO_PRIORITY}); /* where it is allowed */
    write_all(bench.port.url, strlen(bench.port.url));
    write_all("\n", 1);
    for (;;) {
        if (pans_turn(device))
            continue;
        uint64_t wait_ns = settings.awake ? 0 : clock_ns_until(&bench.clock, pans_next_tick(device));
        port_wait(&bench.port, wait_ns < LONGEST_WAIT_NS ? wait_ns : LONGEST_WAIT_NS, pans_has_output(device));
    }
}
