/* The instrument as a whole: its settings, and the hardware's functions made of port, clock and light. */
#define _XOPEN_SOURCE 700
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "posix.h"

/* -- settings -- */

enum kind { NUMBER, TEXT };

#define WHOLE(name, member) {name, offsetof(struct settings, member), sizeof(((struct settings *)NULL)->member), NUMBER}
#define WORDS(name) {#name, offsetof(struct settings, name), NAME_BYTES, TEXT}

static const struct {
    const char *name;
    size_t at, size;
    enum kind kind;
} KNOWN[] = {
    WHOLE("tick_hz", limits.tick_hz), WHOLE("parallel", limits.parallel), WHOLE("channels", limits.channels), WHOLE("levels", limits.levels),
    WHOLE("pattern_memory", limits.pattern_memory), WHOLE("pattern_pixels", limits.pattern_pixels), WHOLE("pixel_memory", limits.pixel_memory),
    WHOLE("slot_memory", limits.slot_memory), WHOLE("automaton_states", limits.automaton_states), WHOLE("dwell_steps", limits.dwell_steps),
    WHOLE("show_memory", limits.show_memory), WHOLE("exposure_min_ticks", limits.exposure_min_ticks),
    WHOLE("exposure_max_ticks", limits.exposure_max_ticks), WHOLE("readout_ticks", limits.readout_ticks),
    WHOLE("pattern_ticks", limits.pattern_ticks), WHOLE("turn_ticks", limits.turn_ticks), WHOLE("buffer_messages", limits.buffer_messages),
    WHOLE("buffer_bytes", limits.buffer_bytes), WHOLE("gate_outputs", limits.gate_outputs), WHOLE("gate_pulses", limits.gate_pulses),
    WHOLE("epoch", limits.epoch), WHOLE("offset_ticks", offset_ticks), WHOLE("rate", drift), WHOLE("objects", objects), WHOLE("seed", seed),
    WHOLE("awake", awake), WORDS(listen), WORDS(firmware), WORDS(serial), WORDS(profile), WORDS(scene),
};

static void set(struct settings *settings, const char *name, const char *value)
{
    for (size_t i = 0; i < sizeof KNOWN / sizeof KNOWN[0]; i++) {
        char *place = (char *)settings + KNOWN[i].at;
        if (strcmp(KNOWN[i].name, name) != 0)
            continue;
        if (KNOWN[i].kind == TEXT) {
            snprintf(place, KNOWN[i].size, "%s", value);
            return;
        }
        uint64_t number = strtoull(value, NULL, 10);
        if (KNOWN[i].size == 1)
            *(bool *)(void *)place = number != 0;
        else if (KNOWN[i].size == 2)
            *(uint16_t *)(void *)place = (uint16_t)number;
        else if (KNOWN[i].size == 4)
            *(uint32_t *)(void *)place = (uint32_t)number;
        else
            *(uint64_t *)(void *)place = number;
        return;
    }
    die("unknown setting", name);
}

void read_settings(struct settings *s)
{
    char line[2 * NAME_BYTES];
    memset(s, 0, sizeof *s);
    for (;;) {
        read_line(line, sizeof line);
        if (strcmp(line, "start") == 0)
            break;
        char *value = strchr(line, ' ');
        if (value == NULL)
            die("a setting without a value", line);
        *value = '\0';
        set(s, line, value + 1);
    }
    s->limits.simulated = true;
    s->limits.block_bytes = s->limits.payload_bytes = 65536;
    s->limits.port_bytes = 65536;
    s->limits.pending_exposures = 2;
    s->limits.firmware = s->firmware;
    s->limits.serial = s->serial;
    s->facts[0] = (struct pans_fact){"profile", s->profile, 0};
    s->facts[1] = (struct pans_fact){"scene", s->scene, 0};
    s->facts[2] = (struct pans_fact){"objects", NULL, s->objects};
    s->facts[3] = (struct pans_fact){"seed", NULL, s->seed};
    s->limits.facts = s->facts;
    s->limits.n_facts = 4;
}

/* -- the hardware's functions -- */

static uint64_t hw_now(void *self)
{
    return clock_tick(&((struct bench *)self)->clock);
}

static size_t hw_read(void *self, uint8_t *bytes, size_t room)
{
    return port_read(&((struct bench *)self)->port, bytes, room);
}

static size_t hw_write(void *self, const uint8_t *bytes, size_t count)
{
    return port_write(&((struct bench *)self)->port, bytes, count);
}

static void hw_store(void *self, const struct pans_pixels *pixels)
{
    (void)self;
    light_store(pixels);
}

static enum pans_status hw_prepare(void *self, const struct pans_task *task, const char **why)
{
    return light_prepare(&((struct bench *)self)->light, task, why);
}

static uint64_t hw_expose(void *self, const struct pans_exposure *exposure)
{
    light_expose(&((struct bench *)self)->light, exposure);
    return exposure->tick; /* a simulator is never late itself */
}

static uint64_t hw_clicks(void *self, uint8_t *word, uint16_t bytes)
{
    struct light *light = &((struct bench *)self)->light;
    (void)bytes;
    light_clicks(light, word);
    return light->now.tick + light->now.ticks;
}

static void hw_dark(void *self)
{
    (void)self;
}

static void hw_gate(void *self, uint16_t output, bool open, uint64_t tick)
{
    (void)self, (void)output, (void)open, (void)tick;
}

static bool hw_mark(void *self, uint32_t object, int16_t *truth, float *photons)
{
    return light_mark(&((struct bench *)self)->light, object, truth, photons);
}

struct pans_device *switch_on(struct settings *settings, struct bench *bench, uint64_t tick)
{
    const struct pans_hardware hardware = {.self = bench,         .now = hw_now,       .read = hw_read,     .write = hw_write,
                                           .store = hw_store,     .prepare = hw_prepare, .dark = hw_dark,   .mark = hw_mark,
                                           .expose = hw_expose,   .clicks = hw_clicks, .gate = hw_gate};
    light_init(&bench->light, settings->limits.channels);
    size_t bytes = pans_memory_bytes(&settings->limits);
    bench->memory = bytes == 0 ? NULL : malloc(bytes);
    struct pans_device *device = pans_start(&settings->limits, &hardware, bench->memory, bytes, tick);
    if (device == NULL)
        die("no device", bytes == 0 ? "settings that cannot be meant" : "no memory");
    return device;
}
