/* What the files of the board share. */
#ifndef PANS_RP2040_BOARD_H
#define PANS_RP2040_BOARD_H

#include "../pans_device.h"

/* projector.c: the projector behind SPI 0. A lab that has another one writes these three anew. */
void projector_start(void);
void projector_store(const struct pans_pixels *pixels); /* while no run is on; NULL: forget all */
void projector_choose(uint16_t pattern);                /* from an interrupt: microseconds */

/* epoch.c: a number that no earlier start has had; 0 when the flash does not keep it */
uint32_t next_epoch(void);

/* usb.c: the port */
void port_start(const char *serial); /* the text stays with the caller */
size_t port_read(uint8_t *bytes, size_t room);
size_t port_write(const uint8_t *bytes, size_t count);

#endif
