/* The board as it once was: it has no interrupt, and the main loop switches gate and light when it comes to it. */
#define main board_main
#include "board.c"
#undef main

enum { BOTH = 1u << LIGHT | 1u << DETECTOR_GATE };
static uint64_t light_off;

static uint64_t polled_expose(void *self, const struct pans_exposure *exposure)
{
    const struct pans_light *light = &exposure->light;
    bool lit = light->pattern != PANS_DARK;
    (void)self;
    wait_until(exposure->tick);
    uint64_t began = time_us_64();
    while (!pio_sm_is_rx_fifo_empty(pio, click_machine))
        (void)pio_sm_get(pio, click_machine);
    gpio_set_mask(lit ? BOTH : 1u << DETECTOR_GATE);
    light_off = lit ? began + light->ticks : PANS_NEVER;
    return began;
}

static uint64_t polled_clicks(void *self, uint8_t *word, uint16_t bytes)
{
    (void)self, (void)bytes;
    uint64_t ended = time_us_64();
    gpio_clr_mask(BOTH);
    light_off = PANS_NEVER;
    word[0] = !pio_sm_is_rx_fifo_empty(pio, click_machine);
    return ended;
}

static void polled_dark(void *self)
{
    (void)self;
    gpio_clr_mask(BOTH);
    light_off = PANS_NEVER;
}

int main(void)
{
    static const struct pans_hardware hardware = {
        .now = hw_now, .read = hw_read, .write = hw_write, .store = hw_store, .prepare = hw_prepare, .dark = polled_dark, .mark = hw_mark,
        .show = hw_show, .expose = polled_expose, .clicks = polled_clicks, .gate = hw_gate,
    };
    limits.serial = "polled";
    limits.epoch = next_epoch();
    start_outputs();
    start_clicks();
    gpio_init_mask(BOTH);
    gpio_set_dir_out_masked(BOTH);
    projector_start();
    port_start(limits.serial);
    light_off = PANS_NEVER;
    board.device = pans_start(&limits, &hardware, memory, sizeof memory, time_us_64());
    for (;;) {
        pans_turn(board.device);
        if (time_us_64() >= light_off)
            gpio_clr_mask(1u << LIGHT);
    }
}
