/* What the files of the emulated board share. */
#ifndef PANS_MPS2_BOARD_H
#define PANS_MPS2_BOARD_H

#include "../pans_device.h"

#define TICK_HZ 25000000u /* of the board's counter */

/* board.c */
void timer_interrupt(void);
uint64_t tick(void);
extern uint64_t line_offset; /* ticks that a line in lock-step has skipped, less those that were none of the device's */
void log_number(const char *name, uint64_t number);
void log_line(uint64_t first, uint64_t second, uint64_t third);
void board_report(void); /* the log of the run */
void leave(void); /* end the emulator */

/* start.c */
uint32_t stack_used(void);

/* light.c or canned.c: projector and detector, of a board that stands before no light */
void light_init(void);
void light_store(const struct pans_pixels *pixels); /* NULL: forget all */
bool light_click(const struct pans_exposure *exposure);
int16_t light_class(uint32_t object);
uint32_t light_objects(void);

/* lockstep.c or canned.c: the host's end of the line */
size_t line_read(uint8_t *bytes, size_t room);
size_t line_write(const uint8_t *bytes, size_t count);
void line_wait(uint64_t next); /* nothing happens by itself before the tick `next` */
void line_report(void);        /* a run is over */

#endif
