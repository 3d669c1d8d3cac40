/* The instrument on an RP2040 (Raspberry Pi Pico) or RP2350 (Pico 2).
 *
 *   GPIO 2      light: high while the pattern is to be lit (the projector's trigger, or the lamp's)
 *   GPIO 3      the detector's gate: high during an exposure
 *   GPIO 5      pulses of the detector: a rising edge while the gate is high is a click
 *   GPIO 6..9   the four actuation outputs
 *   GPIO 16..19 SPI to the projector: projector.c
 *   USB         CDC, serial number from the chip
 *
 * A PIO state machine makes light and gate (pulse.pio), from the tick at which the processor starts it: both end by themselves. Another one looks
 * for clicks. An alarm of the timer calls pans_edge LEAD_US ahead, above all other interrupts. When an exposure began and ended is read from the
 * gate's pin. The watchdog is fed while the main loop turns and edges are served; when it bites, the chip restarts with all pins low. The timer
 * counts microseconds in 64 bits. Docs: docs/how-to/bench.md.
 */
#include "board.h"
#include "hardware/clocks.h"
#include "hardware/irq.h"
#include "hardware/pio.h"
#include "hardware/sync.h"
#include "hardware/timer.h"
#include "hardware/watchdog.h"
#include "pico/stdlib.h"
#include "pico/unique_id.h"
#include "pulse.pio.h"

enum { LIGHT = 2, DETECTOR_GATE = 3, PULSES = 5, FIRST_OUTPUT = 6, OUTPUTS = 4, ALARM = 0 };

#define TICK_HZ 1000000u
#define LEAD_US 10u      /* more than the interrupt, the longest `hold` and what expose does ahead of its tick */
#define WATCHDOG_MS 100u /* a loop that hangs: no light after so long */
#define OVERSHOOT_US 3u  /* a gate that has not closed by itself is closed */
#define OVERDUE_US 2000u /* an edge that nobody serves for so long is a hang too */

static struct {
    struct pans_device *device;
    uint32_t cycles; /* of the state machine in a microsecond */
    uint64_t end; /* of the exposure under way */
} board;

static const PIO pio = pio0;
static const uint machine = 0, click_machine = 1;
static uint program;

/* -- clock and alarm -- */

static uint64_t hw_now(void *self)
{
    (void)self;
    return time_us_64();
}

/* A tick that is at most half an hour ahead: looked at in a few cycles. */
static void wait_until(uint64_t tick)
{
    while ((int32_t)(timer_hw->timerawl - (uint32_t)tick) < 0)
        continue;
}

static void schedule(void)
{
    uint64_t edge = pans_edge_tick(board.device);
    if (edge == PANS_NEVER)
        return;
    timer_hw->alarm[ALARM] = (uint32_t)(edge - LEAD_US);
    if (edge <= time_us_64() + LEAD_US)
        hw_set_bits(&timer_hw->intf, 1u << ALARM); /* the alarm would be missed */
}

static void edge_interrupt(void)
{
    uint64_t edge;
    hw_clear_bits(&timer_hw->intf, 1u << ALARM);
    timer_hw->intr = 1u << ALARM;
    while ((edge = pans_edge_tick(board.device)) != PANS_NEVER && edge <= time_us_64() + LEAD_US)
        pans_edge(board.device);
    schedule(); /* also of an alarm that was further ahead than 32 bits */
}

static void hw_hold(void *self, bool on)
{
    (void)self;
    if (!on)
        schedule();
    irq_set_enabled(hardware_alarm_get_irq_num(ALARM), !on);
    __dsb();
    __isb(); /* from here on it holds */
}

/* -- exposures -- */

static void hw_show(void *self, const struct pans_exposure *next)
{
    (void)self;
    if (next->light.pattern != PANS_DARK)
        projector_choose(next->light.pattern);
}

static uint64_t hw_expose(void *self, const struct pans_exposure *exposure)
{
    (void)self;
    const struct pans_light *light = &exposure->light;
    bool lit = light->pattern != PANS_DARK;
    uint32_t whole = exposure->ticks * board.cycles;
    uint32_t on = lit && light->dwell < light->dwell_steps ? (uint32_t)((uint64_t)whole * light->dwell / light->dwell_steps) : whole - 2;
    on = on < 2 ? 2 : on > whole - 2 ? whole - 2 : on; /* the least that the state machine can do: 16 ns */
    pio_sm_put(pio, machine, on - 2);
    pio_sm_put(pio, machine, whole - on - 2);
    while (!pio_sm_is_rx_fifo_empty(pio, click_machine)) /* the gate is closed: no more come */
        (void)pio_sm_get(pio, click_machine);
    wait_until(exposure->tick);
    pio_sm_put(pio, machine, lit ? 3 : 2);
    for (uint32_t i = 0; i < 100 && !gpio_get(DETECTOR_GATE); i++)
        continue;
    uint64_t began = time_us_64();
    board.end = began + exposure->ticks;
    return began;
}

static void hw_dark(void *self)
{
    (void)self;
    pio_sm_set_enabled(pio, machine, false);
    pio_sm_clear_fifos(pio, machine);
    pio_sm_restart(pio, machine);
    pio_sm_exec(pio, machine, pio_encode_set(pio_pins, 0));
    pio_sm_exec(pio, machine, pio_encode_jmp(program));
    pio_sm_set_enabled(pio, machine, true);
}

static uint64_t hw_clicks(void *self, uint8_t *word, uint16_t bytes)
{
    (void)bytes;
    uint32_t latest = (uint32_t)board.end + OVERSHOOT_US;
    while (gpio_get(DETECTOR_GATE) && (int32_t)(timer_hw->timerawl - latest) < 0)
        continue;
    uint64_t ended = time_us_64();
    if (gpio_get(DETECTOR_GATE))
        hw_dark(self); /* what should have ended by itself */
    word[0] = !pio_sm_is_rx_fifo_empty(pio, click_machine);
    return ended;
}

static void hw_gate(void *self, uint16_t output, bool open, uint64_t tick)
{
    (void)self;
    wait_until(tick);
    gpio_put(FIRST_OUTPUT + output, open);
}

/* -- what may wait -- */

static size_t hw_read(void *self, uint8_t *bytes, size_t room)
{
    (void)self;
    return port_read(bytes, room);
}

static size_t hw_write(void *self, const uint8_t *bytes, size_t count)
{
    (void)self;
    return port_write(bytes, count);
}

static void hw_store(void *self, const struct pans_pixels *pixels)
{
    (void)self;
    projector_store(pixels);
}

static enum pans_status hw_prepare(void *self, const struct pans_task *task, const char **why)
{
    (void)self, (void)task, (void)why;
    return PANS_DONE; /* the projector shows each pattern by its number */
}

static bool hw_mark(void *self, uint32_t object, int16_t *truth, float *photons)
{
    (void)self, (void)object, (void)truth, (void)photons;
    return false; /* hardware does not know what it looks at */
}

/* -- start -- */

static void start_pulses(void)
{
    program = (uint)pio_add_program(pio, &pulse_program);
    pio_sm_config config = pulse_program_get_default_config(program);
    sm_config_set_out_pins(&config, LIGHT, 2);
    sm_config_set_set_pins(&config, LIGHT, 2);
    pio_gpio_init(pio, LIGHT);
    pio_gpio_init(pio, DETECTOR_GATE);
    pio_sm_init(pio, machine, program, &config);
    pio_sm_set_consecutive_pindirs(pio, machine, LIGHT, 2, true);
    hw_dark(NULL);
    board.cycles = clock_get_hz(clk_sys) / TICK_HZ;
}

static void start_clicks(void)
{
    uint offset = (uint)pio_add_program(pio, &click_program);
    pio_sm_config config = click_program_get_default_config(offset);
    gpio_init(PULSES);
    gpio_pull_down(PULSES);
    sm_config_set_in_pins(&config, PULSES);
    sm_config_set_jmp_pin(&config, DETECTOR_GATE);
    pio_sm_init(pio, click_machine, offset, &config);
    pio_sm_set_enabled(pio, click_machine, true);
}

static void start_outputs(void)
{
    for (uint pin = FIRST_OUTPUT; pin < FIRST_OUTPUT + OUTPUTS; pin++) {
        gpio_init(pin);
        gpio_set_dir(pin, GPIO_OUT);
    }
}

static void start_alarm(void)
{
    uint irq = hardware_alarm_get_irq_num(ALARM);
    hardware_alarm_claim(ALARM);
    irq_set_exclusive_handler(irq, edge_interrupt);
    irq_set_priority(irq, PICO_HIGHEST_IRQ_PRIORITY); /* above that of USB */
    hw_set_bits(&timer_hw->inte, 1u << ALARM);
    irq_set_enabled(irq, true);
}

static bool edges_are_served(void)
{
    hw_hold(NULL, true);
    uint64_t edge = pans_edge_tick(board.device);
    hw_hold(NULL, false);
    return edge == PANS_NEVER || edge + OVERDUE_US > time_us_64();
}

static struct pans_limits limits = {
    .tick_hz = TICK_HZ,
    .channels = 1,
    .levels = 2,
    .pattern_memory = 4096,
    .pattern_pixels = 1024,
    .pixel_memory = 4096u * 1024u, /* the projector's */
    .slot_memory = 512,
    .automaton_states = 4096,
    .dwell_steps = 1000,
    .show_memory = 64,
    .exposure_min_ticks = 40,
    .exposure_max_ticks = 1000000,
    .readout_ticks = 10, /* from the end of one exposure to the start of the next the interrupt takes 8 us */
    .pattern_ticks = 44, /* of a DLP7000: 23.1 kHz */
    .turn_ticks = 50,    /* the same, and what the core takes to choose */
    .buffer_messages = 128,
    .buffer_bytes = 24576,
    .block_bytes = 4096,
    .payload_bytes = 12416, /* more than this host ever sends */
    .port_bytes = 512,
    .pending_exposures = 64,
    .gate_outputs = OUTPUTS,
    .gate_pulses = 32,
    .firmware = "pans-reference 2 (" PICO_BOARD ")",
};

static uint64_t memory[(160u << 10) / 8];

int main(void)
{
    static const struct pans_hardware hardware = {
        .now = hw_now, .read = hw_read, .write = hw_write, .store = hw_store, .prepare = hw_prepare, .dark = hw_dark, .mark = hw_mark,
        .hold = hw_hold, .show = hw_show, .expose = hw_expose, .clicks = hw_clicks, .gate = hw_gate,
    };
    static char serial[2 * PICO_UNIQUE_BOARD_ID_SIZE_BYTES + 1];
    pico_get_unique_board_id_string(serial, sizeof serial);
    limits.serial = serial;
    limits.epoch = next_epoch();
    start_outputs();
    start_pulses();
    start_clicks();
    projector_start();
    port_start(serial);
    board.device = pans_start(&limits, &hardware, memory, sizeof memory, time_us_64());
    if (board.device == NULL || limits.epoch == 0)
        return 1; /* all pins stay low, and a host finds nobody */
    start_alarm();
    watchdog_enable(WATCHDOG_MS, false);
    for (;;) {
        pans_turn(board.device);
        if (edges_are_served())
            watchdog_update();
    }
}
