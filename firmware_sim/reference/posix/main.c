/* The program: an instrument behind its port, until standard input ends. */
#define _GNU_SOURCE /* SCHED_IDLE, where there is one */
#include <errno.h>
#include <pthread.h>
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

#ifdef SCHED_IDLE
/* A core that halts between two slots, a virtual one above all, takes tens of microseconds to wake. This thread of idle priority keeps it
   awake. The loop itself may not spin: the kernel stops those at real-time priority for 50 ms in every second (sched_rt_runtime_us). */
static void *spin(void *unused)
{
    if (sched_setscheduler(0, SCHED_IDLE, &(struct sched_param){0}) == 0) /* 0: this thread */
        for (;;) {
        }
    return unused;
}

static void keep_awake(void)
{
    pthread_t thread;
    if (pthread_create(&thread, NULL, spin, NULL) != 0)
        fprintf(stderr, "pans-reference: the core is not kept awake: no thread for it\n");
}
#else
static void keep_awake(void)
{
    fprintf(stderr, "pans-reference: the core is not kept awake: this system has no SCHED_IDLE\n");
}
#endif

int main(void)
{
    static struct settings settings;
    static struct bench bench;
    read_settings(&settings);
    bench.clock = (struct clock){settings.limits.tick_hz, settings.offset_ticks, settings.drift};
    open_port(&bench.port, settings.listen);
    if (settings.awake)
        keep_awake();
    struct pans_device *device = switch_on(&settings, &bench, clock_tick(&bench.clock));
    sched_setscheduler(0, SCHED_FIFO, &(struct sched_param){.sched_priority = FIFO_PRIORITY}); /* where it is allowed */
    write_all(bench.port.url, strlen(bench.port.url));
    write_all("\n", 1);
    for (;;) {
        if (pans_turn(device))
            continue;
        uint64_t wait_ns = clock_ns_until(&bench.clock, pans_next_tick(device));
        port_wait(&bench.port, wait_ns < LONGEST_WAIT_NS ? wait_ns : LONGEST_WAIT_NS, pans_has_output(device));
    }
}
