/* The light: click thresholds that the Python simulator computes once per measurement, and the random numbers that are held against them.
 *
 * The file is an array of 64-bit words in the machine's order: the header, thresholds (objects, columns + 1), if there is afterpulsing the same
 * after a click, then the expected photoelectrons of every pattern (objects, columns) as doubles where the host names states, the
 * photoelectrons of one shot on each object, and the classes. A column is a pattern, a channel or a state; the last one is dark. A
 * threshold is the probability times 2^53, rounded up. Where dead time matters, the table of counted over true means closes the file.
 *
 * The generator is a counter: the number of an exposure depends on the seed, its number and the channel alone. Its finaliser is that of Steele,
 * Lea and Flood, "Fast splittable pseudorandom number generators" (2014); it draws what the Python simulator draws.
 */
#define _XOPEN_SOURCE 700
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include "posix.h"

enum { MAGIC_AT, OBJECTS, COLUMNS, PARALLEL, KEY, KEY_BELOW, KEY_ABOVE, CROSSTALK, HAS_PRIMED, HAS_MEAN, COUNTED, DARK, AFTERPULSE, STEP, HEADER_WORDS = 16 };

#define MAGIC 0x31474C534E4150u /* "PANSLG1" */
#define GOLDEN 0x9E3779B97F4A7C15u
#define CHANNEL_STEP 0xD1342543DE82EF95u

static uint64_t mix(uint64_t word)
{
    word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9u;
    word = (word ^ word >> 27) * 0x94D049BB133111EBu;
    return word ^ word >> 31;
}

static uint64_t number(uint64_t key, uint64_t draw, uint64_t channel)
{
    return mix(mix(draw * GOLDEN + key) + (channel + 1) * CHANNEL_STEP) >> 11;
}

void light_init(struct light *light, uint16_t channels)
{
    memset(light, 0, sizeof *light);
    light->before = calloc(2, channels);
    light->present = light->before + channels;
    if (light->before == NULL)
        die("no memory", "");
}

void light_close(struct light *light)
{
    if (light->mapped != NULL)
        munmap(light->mapped, light->mapped_bytes);
    free(light->before);
}

void light_store(const struct pans_pixels *pixels)
{
    char line[NAME_BYTES];
    if (pixels == NULL) {
        write_all("forget\n", 7);
        return;
    }
    int count = snprintf(line, sizeof line, "pixels %u %u %u %u %d\n", pixels->pattern, (unsigned)pixels->first, (unsigned)pixels->whole,
                         (unsigned)pixels->count, pixels->bits);
    write_all(line, (size_t)count);
    write_all(pixels->data, pixels->bits ? (pixels->count + 7u) / 8 : 2u * pixels->count);
}

/* -- the file -- */

static double real(uint64_t word)
{
    double value;
    memcpy(&value, &word, sizeof value);
    return value;
}

static void map_file(struct light *light, const char *path)
{
    struct stat facts;
    int file = open(path, O_RDONLY);
    if (light->mapped != NULL)
        munmap(light->mapped, light->mapped_bytes);
    light->mapped = NULL;
    if (file < 0 || fstat(file, &facts) != 0 || facts.st_size < (off_t)(8 * HEADER_WORDS))
        die("cannot read the light's file", path);
    light->mapped_bytes = (size_t)facts.st_size;
    light->mapped = mmap(NULL, light->mapped_bytes, PROT_READ, MAP_PRIVATE, file, 0);
    close(file);
    if (light->mapped == MAP_FAILED)
        die("cannot map the light's file", path);
}

static void take_file(struct light *light, const char *path)
{
    map_file(light, path);
    const uint64_t *word = light->mapped;
    uint64_t objects = word[OBJECTS], columns = word[COLUMNS], table = objects * (columns + 1);
    uint64_t words = HEADER_WORDS + table * (1 + word[HAS_PRIMED]) + objects * columns * word[HAS_MEAN] + 2 * objects + word[COUNTED];
    if (word[MAGIC_AT] != MAGIC || objects == 0 || words * 8 != light->mapped_bytes)
        die("not a file of light", path);
    light->header = word;
    word += HEADER_WORDS;
    light->limit = word;
    word += table;
    light->primed = light->header[HAS_PRIMED] ? word : light->limit;
    word += table * light->header[HAS_PRIMED];
    light->mean = (const double *)word;
    word += objects * columns * light->header[HAS_MEAN];
    light->photons = (const double *)word;
    light->truth = (const int64_t *)(word + objects);
    light->counted = (const double *)(word + 2 * objects);
}

static void send_states(const struct pans_task *task)
{
    for (uint32_t i = 0; i < task->n_states; i++) {
        uint32_t next[2];
        struct pans_light shown = task->state(task->device, (uint16_t)i, next);
        uint32_t row[5] = {shown.pattern, shown.dwell, shown.dwell_steps, next[0], next[1]};
        write_all(row, sizeof row);
    }
}

enum pans_status light_prepare(struct light *light, const struct pans_task *task, const char **why)
{
    const uint64_t key[6] = {task->patterns_revision, task->n_patterns, task->exposure_ticks, task->adaptive, task->n_states,
                             task->n_states == 0 ? 0 : task->states_revision};
    char line[NAME_BYTES + 16];
    unsigned status;
    int read;
    if (light->mapped != NULL && memcmp(key, light->key, sizeof key) == 0)
        return PANS_DONE;
    int count = snprintf(line, sizeof line, "light %u %u %d %u\n", task->n_patterns, (unsigned)task->exposure_ticks, task->adaptive, task->n_states);
    write_all(line, (size_t)count);
    send_states(task);
    read_line(line, sizeof line);
    if (strncmp(line, "table ", 6) == 0) {
        take_file(light, line + 6);
        memcpy(light->key, key, sizeof key);
        return PANS_DONE;
    }
    if (sscanf(line, "refused %u %n", &status, &read) != 1 || status == 0 || status > PANS_LATE)
        die("an answer that was not expected", line);
    snprintf(light->why, sizeof light->why, "%s", line + read);
    *why = light->why;
    return (enum pans_status)status;
}

/* -- exposures -- */

void light_expose(struct light *light, const struct pans_exposure *exposure)
{
    light->now = *exposure;
    light->draw_now = light->draws++;
    if (exposure->number == 0)
        memset(light->before, 0, light->header[PARALLEL] ? light->header[COLUMNS] : 1);
}

/* What dead time leaves of the mean: its table, as runtime/instrument/dead_time.py makes it, read at log(1 + mean). */
static double counted(const struct light *light, double mean)
{
    uint64_t entries = light->header[COUNTED];
    if (entries == 0)
        return mean;
    double at = fmin(log1p(mean) / real(light->header[STEP]), (double)(entries - 1));
    uint64_t left = at < (double)(entries - 1) ? (uint64_t)at : entries - 2;
    return mean * (light->counted[left] + (light->counted[left + 1] - light->counted[left]) * (at - (double)left));
}

/* The probability times 2^53 of an exposure with the light on for a part of it: the thresholded Poisson law. */
static uint64_t limit_of(const struct light *light, double photoelectrons, bool after_click)
{
    double p = -expm1(-counted(light, photoelectrons + real(light->header[DARK])));
    if (after_click)
        p = 1.0 - (1.0 - p) * (1.0 - real(light->header[AFTERPULSE]));
    return (uint64_t)ceil(p * 9007199254740992.0);
}

static uint8_t one_click(const struct light *light)
{
    uint64_t columns = light->header[COLUMNS], object = light->now.object % light->header[OBJECTS], column = light->now.light.pattern;
    const struct pans_light *shown = &light->now.light;
    bool after_click = light->before[0] != 0 && light->header[HAS_PRIMED];
    uint64_t drawn = number(light->header[KEY], light->draw_now, 0);
    if (light->now.state != PANS_DARK)
        column = light->now.state; /* a file of a device-driven automaton has a column for each state */
    else if (shown->pattern == PANS_DARK)
        column = columns;
    else if (shown->dwell != shown->dwell_steps) {
        double part = (double)shown->dwell / shown->dwell_steps;
        return drawn < limit_of(light, light->mean[object * columns + column] * part, after_click);
    }
    return drawn < (after_click ? light->primed : light->limit)[object * (columns + 1) + column];
}

static void many_clicks(struct light *light)
{
    const uint64_t *h = light->header;
    uint64_t columns = h[COLUMNS], draw = light->draw_now, row = light->now.object % h[OBJECTS] * (columns + 1);
    bool dark = light->now.light.pattern == PANS_DARK;
    uint8_t *own = light->present, *all = light->before;
    for (uint64_t c = 0; c < columns; c++) {
        const uint64_t *limit = all[c] ? light->primed : light->limit;
        own[c] = number(h[KEY], draw, c) < limit[row + (dark ? columns : c)];
    }
    memcpy(all, own, columns);
    for (uint64_t c = 0; h[CROSSTALK] != 0 && c < columns; c++) {
        if (own[c] && c + 1 < columns && number(h[KEY_BELOW], draw, c + 1) < h[CROSSTALK])
            all[c + 1] = 1;
        if (own[c] && c > 0 && number(h[KEY_ABOVE], draw, c - 1) < h[CROSSTALK])
            all[c - 1] = 1;
    }
}

void light_clicks(struct light *light, uint8_t *word)
{
    if (!light->header[PARALLEL]) {
        word[0] = light->before[0] = one_click(light);
        return;
    }
    many_clicks(light);
    for (uint64_t c = 0; c < light->header[COLUMNS]; c++)
        word[c / 8] = (uint8_t)(word[c / 8] | light->before[c] << c % 8);
}

bool light_mark(const struct light *light, uint32_t object, int16_t *truth, float *photons)
{
    uint64_t row = object % light->header[OBJECTS];
    *truth = (int16_t)light->truth[row];
    *photons = (float)light->photons[row];
    return true;
}
