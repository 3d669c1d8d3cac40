/* The projector behind SPI 0 (GPIO 16 to 19, 31.25 Mbit/s, mode 0). On the line, numbers low byte first:
 *   'F'                                                        forget all patterns
 *   'P', u16 pattern, u16 first, u16 count, u8 bits, pixels    `count` pixels from `first` on; bits 1: eight a byte, lowest bit first; 0: u16 levels
 *   'C', u16 pattern                                           show this one with the next trigger
 */
#include "board.h"
#include "hardware/gpio.h"
#include "hardware/spi.h"

enum { FIRST_PIN = 16, LAST_PIN = 19, BAUD = 31250000 };

void projector_start(void)
{
    spi_init(spi0, BAUD);
    for (uint pin = FIRST_PIN; pin <= LAST_PIN; pin++)
        gpio_set_function(pin, GPIO_FUNC_SPI);
}

void projector_store(const struct pans_pixels *pixels)
{
    if (pixels == NULL) {
        spi_write_blocking(spi0, (const uint8_t *)"F", 1);
        return;
    }
    const uint16_t numbers[3] = {pixels->pattern, (uint16_t)pixels->first, (uint16_t)pixels->count};
    uint8_t head[8] = {'P'};
    for (size_t i = 0; i < 3; i++) {
        head[1 + 2 * i] = (uint8_t)numbers[i];
        head[2 + 2 * i] = (uint8_t)(numbers[i] >> 8);
    }
    head[7] = pixels->bits;
    spi_write_blocking(spi0, head, sizeof head);
    spi_write_blocking(spi0, pixels->data, pixels->bits ? (pixels->count + 7u) / 8 : 2u * pixels->count);
}

void projector_choose(uint16_t pattern)
{
    const uint8_t words[3] = {'C', (uint8_t)pattern, (uint8_t)(pattern >> 8)};
    spi_write_blocking(spi0, words, sizeof words);
}
