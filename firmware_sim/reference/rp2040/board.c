/* A worked example: the instrument on an RP2040 (Raspberry Pi Pico), bare registers and TinyUSB.
 *
 *   USB CDC    TinyUSB's device stack carries the bytes; the pico-sdk brings it, and its descriptors.
 *   GPIO 2     trigger of the projector: rises when a pattern is to be shown, falls when the light is to go out
 *   GPIO 3     gate of the detector: high while it is open
 *   GPIO 5     pulses of the detector, counted by PWM slice 2 (channel B counts rising edges)
 *   GPIO 6..9  the four actuation outputs
 *   GPIO 16..19 SPI to the projector, which holds the patterns: `send_to_projector` is the one function to fill in
 *
 * The timer counts microseconds in 64 bits, so that tick_hz is 1 000 000. Register addresses: RP2040 datasheet, sections 2.3.1.7 (SIO),
 * 4.5.3 (PWM), 4.6.5 (timer).
 */
#include "../pans_device.h"

#define REGISTER(address) (*(volatile uint32_t *)(uintptr_t)(address))
#define SIO_GPIO_OUT_SET REGISTER(0xD0000014)
#define SIO_GPIO_OUT_CLR REGISTER(0xD0000018)
#define SIO_GPIO_OE_SET REGISTER(0xD0000024)
#define TIMER_RAW_HIGH REGISTER(0x40054024)
#define TIMER_RAW_LOW REGISTER(0x40054028)
#define PWM_SLICE_2 0x40050028u
#define PWM_CSR REGISTER(PWM_SLICE_2 + 0x00)
#define PWM_DIV REGISTER(PWM_SLICE_2 + 0x04)
#define PWM_CTR REGISTER(PWM_SLICE_2 + 0x08)
#define PWM_TOP REGISTER(PWM_SLICE_2 + 0x10)
#define IO_BANK_FUNCTION(pin) REGISTER(0x40014004u + 8u * (pin))

enum { TRIGGER = 2, DETECTOR_GATE = 3, PULSES = 5, FIRST_OUTPUT = 6, OUTPUTS = 4, FUNCTION_PWM = 4, FUNCTION_SIO = 5 };

#define TICK_HZ 1000000u
#define LIGHT_RISE_US 2u /* what the trigger takes until there is light: measure yours */

/* TinyUSB (tusb.h) */
extern bool tusb_init(void);
extern void tud_task(void);
extern uint32_t tud_cdc_n_read(uint8_t port, void *bytes, uint32_t room);
extern uint32_t tud_cdc_n_write(uint8_t port, const void *bytes, uint32_t count);
extern uint32_t tud_cdc_n_write_flush(uint8_t port);

/* The projector's own interface: pixels into its memory, and which pattern the next trigger shows. */
extern void send_to_projector(const struct pans_pixels *pixels);
extern void choose_on_projector(uint16_t pattern);

static struct {
    uint64_t light_off; /* the tick at which the light of the present exposure goes out */
    uint32_t count_before;
} board;

static uint64_t hw_now(void *self)
{
    (void)self;
    for (;;) { /* without the latched pair of registers, which the second core might read at the same time */
        uint32_t high = TIMER_RAW_HIGH, low = TIMER_RAW_LOW;
        if (high == TIMER_RAW_HIGH)
            return (uint64_t)high << 32 | low;
    }
}

static size_t hw_read(void *self, uint8_t *bytes, size_t room)
{
    (void)self;
    tud_task();
    return tud_cdc_n_read(0, bytes, (uint32_t)room);
}

static size_t hw_write(void *self, const uint8_t *bytes, size_t count)
{
    (void)self;
    uint32_t took = count == 0 ? 0 : tud_cdc_n_write(0, bytes, (uint32_t)count);
    if (took != 0)
        tud_cdc_n_write_flush(0); /* a short frame is one that the host waits for */
    return took;
}

static void hw_store(void *self, const struct pans_pixels *pixels)
{
    (void)self;
    if (pixels != NULL)
        send_to_projector(pixels);
}

static enum pans_status hw_prepare(void *self, const struct pans_task *task, const char **why)
{
    (void)self, (void)task, (void)why;
    return PANS_DONE; /* the projector shows each pattern by its number */
}

static uint64_t hw_expose(void *self, const struct pans_exposure *exposure)
{
    bool lit = exposure->light.pattern != PANS_DARK;
    if (lit)
        choose_on_projector(exposure->light.pattern);
    while (hw_now(self) < exposure->tick) /* the main loop calls a little ahead of time: see main */
        continue;
    uint64_t began = hw_now(self);
    board.count_before = PWM_CTR;
    SIO_GPIO_OUT_SET = 1u << DETECTOR_GATE | (lit ? 1u << TRIGGER : 0);
    board.light_off = lit ? began + (uint64_t)exposure->ticks * exposure->light.dwell / exposure->light.dwell_steps : PANS_NEVER;
    return began;
}

static uint64_t hw_clicks(void *self, uint8_t *word, uint16_t bytes)
{
    (void)self, (void)bytes;
    uint64_t ended = hw_now(self);
    SIO_GPIO_OUT_CLR = 1u << DETECTOR_GATE | 1u << TRIGGER;
    board.light_off = PANS_NEVER;
    word[0] = PWM_CTR != board.count_before;
    return ended;
}

static void hw_dark(void *self)
{
    (void)self;
    SIO_GPIO_OUT_CLR = 1u << DETECTOR_GATE | 1u << TRIGGER;
    board.light_off = PANS_NEVER;
}

static void hw_gate(void *self, uint16_t output, bool open, uint64_t tick)
{
    (void)self, (void)tick;
    uint32_t pin = 1u << (FIRST_OUTPUT + output);
    if (open)
        SIO_GPIO_OUT_SET = pin;
    else
        SIO_GPIO_OUT_CLR = pin;
}

static bool hw_mark(void *self, uint32_t object, int16_t *truth, float *photons)
{
    (void)self, (void)object, (void)truth, (void)photons;
    return false; /* hardware does not know what it looks at */
}

static void set_up_pins(void)
{
    static const uint8_t outputs[] = {TRIGGER, DETECTOR_GATE, FIRST_OUTPUT, FIRST_OUTPUT + 1, FIRST_OUTPUT + 2, FIRST_OUTPUT + 3};
    for (size_t i = 0; i < sizeof outputs; i++) {
        SIO_GPIO_OUT_CLR = 1u << outputs[i];
        SIO_GPIO_OE_SET = 1u << outputs[i];
        IO_BANK_FUNCTION(outputs[i]) = FUNCTION_SIO;
    }
    IO_BANK_FUNCTION(PULSES) = FUNCTION_PWM;
    PWM_DIV = 1u << 4;           /* every edge counts */
    PWM_TOP = 0xFFFF;
    PWM_CSR = 2u << 4 | 1u;      /* count rising edges of channel B; go */
}

/* What this board is. 160 patterns, 512 slots and an automaton of 1024 states fit the 264 KiB beside USB. */
static const struct pans_limits LIMITS = {
    .tick_hz = TICK_HZ,
    .channels = 1,
    .levels = 2,
    .pattern_memory = 160,
    .pattern_pixels = 1024,
    .pixel_memory = 160u * 1024u,
    .slot_memory = 512,
    .automaton_states = 1024,
    .dwell_steps = 100,
    .show_memory = 64,
    .exposure_min_ticks = 100,
    .exposure_max_ticks = 1000000,
    .readout_ticks = 50,
    .pattern_ticks = 100,
    .turn_ticks = 50,
    .buffer_messages = 128,
    .buffer_bytes = 32768,
    .block_bytes = 4096,
    .payload_bytes = 65536, /* the protocol's longest */
    .port_bytes = 512,
    .pending_exposures = 16,
    .gate_outputs = OUTPUTS,
    .gate_pulses = 32,
    .epoch = 1, /* count it up in flash at every start, so that the host sees a restart */
    .firmware = "pans-reference 1 (RP2040)",
    .serial = "0001",
};

static uint64_t memory[(168u << 10) / 8];

size_t memory_left(void)
{
    size_t needed = pans_memory_bytes(&LIMITS);
    return needed > sizeof memory ? 0 : sizeof memory - needed;
}

int main(void)
{
    static const struct pans_hardware hardware = {
        .self = &board, .now = hw_now, .read = hw_read, .write = hw_write, .store = hw_store, .prepare = hw_prepare, .dark = hw_dark, .mark = hw_mark,
        .expose = hw_expose, .clicks = hw_clicks, .gate = hw_gate,
    };
    set_up_pins();
    tusb_init();
    board.light_off = PANS_NEVER;
    struct pans_device *device = pans_start(&LIMITS, &hardware, memory, sizeof memory, hw_now(NULL));
    while (device != NULL) {
        pans_turn(device);
        if (hw_now(NULL) + LIGHT_RISE_US >= board.light_off) { /* a dwell time that is shorter than the exposure */
            SIO_GPIO_OUT_CLR = 1u << TRIGGER;
            board.light_off = PANS_NEVER;
        }
    }
    return 1; /* the limits do not fit the memory */
}
