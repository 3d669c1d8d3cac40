/* The instrument on an Arm MPS2 board as QEMU emulates it: FPGAIO's counter is the clock (25 MHz), CMSDK timer 0 calls pans_edge LEAD ticks
 * ahead, UART 1 takes a log. Addresses: Arm DAI0385, DDI0479. The line to the host is canned.c's or lockstep.c's.
 */
#include <string.h>

#include "board.h"

#define REGISTER(address) (*(volatile uint32_t *)(uintptr_t)(address))
#define COUNTER REGISTER(0x40028018)
#define TIMER_CTRL REGISTER(0x40000000)
#define TIMER_VALUE REGISTER(0x40000004)
#define TIMER_RELOAD REGISTER(0x40000008)
#define TIMER_CLEAR REGISTER(0x4000000C)
#define LOG_DATA REGISTER(0x40005000)
#define LOG_STATE REGISTER(0x40005004)
#define LOG_CTRL REGISTER(0x40005008)
#define LOG_BAUDDIV REGISTER(0x40005010)
#define NVIC_ISER REGISTER(0xE000E100)

enum { TX_FULL = 1, TX_ON = 1, TIMER_ON = 1 | 8, TIMER_0 = 8 };

/* The interrupt, the longest `hold` and the hardware functions take less: 20 us. */
#ifndef LEAD
#define LEAD 500u
#endif
#define NEVER_MIND 0x10000000u /* ticks after which the timer looks again */

static struct pans_device *device;

static struct {
    uint64_t high;
    uint32_t low;
    struct pans_exposure now;
    uint64_t began, ended, exposures, aim; /* aim: the counter at the edge for which the timer is set */
    uint64_t late_max, choice_max, edge_max, gate_late_max;
} board;

/* -- clock -- */

static uint32_t mask(void)
{
    uint32_t before;
    __asm volatile("mrs %0, primask\n\tcpsid i" : "=r"(before)::"memory");
    return before;
}

static void unmask(uint32_t before)
{
    __asm volatile("msr primask, %0" ::"r"(before) : "memory");
}

uint64_t line_offset;

uint64_t tick(void)
{
    uint32_t before = mask(), low = COUNTER;
    board.high += low < board.low ? (uint64_t)1 << 32 : 0;
    board.low = low;
    uint64_t now = (board.high | low) + line_offset;
    unmask(before);
    return now;
}

/* -- log -- */

static void log_text(const char *text)
{
    for (; *text != '\0'; text++) {
        while (LOG_STATE & TX_FULL)
            continue;
        LOG_DATA = (uint8_t)*text;
    }
}

static void log_digits(uint64_t number)
{
    char digits[22], *at = digits + sizeof digits - 1;
    *at = '\0';
    do {
        *--at = (char)('0' + number % 10);
        number /= 10;
    } while (number != 0);
    log_text(at);
}

void log_number(const char *name, uint64_t number)
{
    log_text(name);
    log_text(" ");
    log_digits(number);
    log_text("\n");
}

void log_line(uint64_t first, uint64_t second, uint64_t third)
{
    log_digits(first);
    log_text(" ");
    log_digits(second);
    log_text(" ");
    log_digits(third);
    log_text("\n");
}

void leave(void)
{
    register uint32_t what __asm("r0") = 0x18, why __asm("r1") = 0x20026; /* semihosting: the application has ended */
    __asm volatile("bkpt 0xab" ::"r"(what), "r"(why) : "memory");
}

/* -- edges -- */

static void schedule(void)
{
    uint64_t edge = pans_edge_tick(device), now = tick(), wait = NEVER_MIND;
    uint64_t aim = edge == PANS_NEVER ? edge : edge - line_offset;
    if (aim == board.aim)
        return; /* it runs, or has just run out: to set it anew costs an emulator microseconds */
    board.aim = aim;
    TIMER_CTRL = 0;
    TIMER_CLEAR = 1;
    if (edge == PANS_NEVER)
        return;
    if (edge < now + LEAD + NEVER_MIND)
        wait = edge <= now + LEAD ? 1 : edge - now - LEAD;
    TIMER_RELOAD = TIMER_VALUE = (uint32_t)wait;
    TIMER_CTRL = TIMER_ON;
}

void timer_interrupt(void)
{
    uint64_t edge;
    board.aim = 0; /* whatever it was, it is over */
    while ((edge = pans_edge_tick(device)) != PANS_NEVER && edge <= tick() + LEAD) {
        uint64_t from = tick();
        pans_edge(device);
        uint64_t took = tick() - (from > edge ? from : edge); /* what it waited is none of it */
        board.edge_max = took > board.edge_max ? took : board.edge_max;
    }
    schedule();
}

static void hw_hold(void *self, bool on)
{
    (void)self;
    if (on) {
        mask();
        return;
    }
    schedule();
    unmask(0);
}

static void wait_until(uint64_t wanted)
{
    uint32_t end = (uint32_t)(wanted - line_offset);
    if (wanted <= tick())
        return;
    while ((int32_t)(COUNTER - end) < 0)
        continue;
}

static void hw_show(void *self, const struct pans_exposure *next)
{
    (void)self, (void)next;
    uint64_t choice = board.ended == 0 ? 0 : tick() - board.ended;
    board.choice_max = choice > board.choice_max ? choice : board.choice_max;
}

static uint64_t hw_expose(void *self, const struct pans_exposure *exposure)
{
    (void)self;
    if (exposure->number == 0)
        board.exposures = board.late_max = board.choice_max = board.edge_max = board.gate_late_max = board.ended = 0;
    board.now = *exposure;
    wait_until(exposure->tick);
#ifdef DELAY_ONE /* of a test: it must be found */
    if (exposure->number == 1000)
        wait_until(exposure->tick + DELAY_ONE);
#endif
    board.began = tick();
    uint64_t late = board.began - exposure->tick;
    board.late_max = late > board.late_max ? late : board.late_max;
    board.exposures++;
    return board.began;
}

#define LOGGED 4096u
__attribute__((section(".bench"))) static uint32_t late_of[LOGGED], length_of[LOGGED];

static uint64_t hw_clicks(void *self, uint8_t *word, uint16_t bytes)
{
    (void)self, (void)bytes;
    wait_until(board.began + board.now.ticks);
    board.ended = tick();
    late_of[board.now.number % LOGGED] = (uint32_t)(board.began - board.now.tick);
    length_of[board.now.number % LOGGED] = (uint32_t)(board.ended - board.began);
    uint64_t from = tick();
    word[0] = light_click(&board.now);
    line_offset -= tick() - from; /* nature takes no instructions */
    return board.ended;
}

static void hw_gate(void *self, uint16_t output, bool open, uint64_t wanted)
{
    (void)self, (void)output, (void)open;
    wait_until(wanted);
    uint64_t late = tick() - wanted;
    board.gate_late_max = late > board.gate_late_max ? late : board.gate_late_max;
}

/* -- what may wait -- */

static uint64_t hw_now(void *self)
{
    (void)self;
    return tick();
}

static size_t hw_read(void *self, uint8_t *bytes, size_t room)
{
    (void)self;
    return line_read(bytes, room);
}

static size_t hw_write(void *self, const uint8_t *bytes, size_t count)
{
    (void)self;
    return line_write(bytes, count);
}

static void hw_store(void *self, const struct pans_pixels *pixels)
{
    (void)self;
    light_store(pixels);
}

static enum pans_status hw_prepare(void *self, const struct pans_task *task, const char **why)
{
    (void)self, (void)task, (void)why;
    return PANS_DONE;
}

static void hw_dark(void *self)
{
    (void)self;
    line_report();
}

void board_report(void)
{
    uint64_t logged = board.exposures < LOGGED ? board.exposures : LOGGED;
    log_number("exposures", board.exposures);
    for (uint32_t i = 0; i < logged; i++)
        log_line(i, late_of[i], length_of[i]);
    log_number("latest_start_ticks", board.late_max);
    log_number("latest_gate_ticks", board.gate_late_max);
    log_number("longest_choice_ticks", board.choice_max);
    log_number("longest_edge_ticks", board.edge_max);
    log_number("stack_bytes", stack_used());
}

static bool hw_mark(void *self, uint32_t object, int16_t *truth, float *photons)
{
    (void)self;
    static const union {
        uint32_t word;
        float real;
    } unknown = {0x7FC00000u};
    *truth = light_class(object);
    *photons = unknown.real;
    return true;
}

static struct pans_fact facts[] = {{"objects", NULL, 0}, {"scene", "fashion200", 0}};

static struct pans_limits limits = {
    .tick_hz = TICK_HZ,
    .simulated = true,
    .channels = 1,
    .levels = 2,
    .pattern_memory = 4096,
    .pattern_pixels = 1024,
    .pixel_memory = 4096u * 1024u,
    .slot_memory = 512,
    .automaton_states = 4096,
    .dwell_steps = 1000,
    .show_memory = 64,
    .exposure_min_ticks = 1000,
    .exposure_max_ticks = 250000,
    .readout_ticks = 74,
    .pattern_ticks = 1082,
    .turn_ticks = 1099,
    .buffer_messages = 128,
    .buffer_bytes = 32768,
    .block_bytes = 4096,
    .payload_bytes = 16384,
    .port_bytes = 512,
    .pending_exposures = 64,
    .lead_ticks = LEAD,
    .gate_outputs = 4,
    .gate_pulses = 32,
    .epoch = 1,
    .firmware = "pans-reference 2 (MPS2, QEMU)",
    .serial = "mps2-0001",
    .facts = facts,
    .n_facts = sizeof facts / sizeof facts[0],
};

static uint64_t memory[(176u << 10) / 8];

int main(void)
{
    static const struct pans_hardware hardware = {
        .now = hw_now, .read = hw_read, .write = hw_write, .store = hw_store, .prepare = hw_prepare, .dark = hw_dark, .mark = hw_mark,
#ifndef POLLED /* of a test: as firmware without an interrupt would do it */
        .hold = hw_hold,
#endif
        .show = hw_show, .expose = hw_expose, .clicks = hw_clicks, .gate = hw_gate,
    };
    (void)hw_hold;
    LOG_BAUDDIV = 16;
    LOG_CTRL = TX_ON;
    light_init();
    facts[0].number = light_objects();
    log_number("core_bytes", pans_memory_bytes(&limits));
    device = pans_start(&limits, &hardware, memory, sizeof memory, tick());
#ifndef POLLED
    NVIC_ISER = 1u << TIMER_0;
#endif
    while (device != NULL) {
        pans_turn(device);
        if (!pans_has_output(device))
            line_wait(pans_next_tick(device));
    }
    return 1;
}
