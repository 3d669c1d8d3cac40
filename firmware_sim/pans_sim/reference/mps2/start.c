/* Start-up of a Cortex-M: vectors, memory, and a stack that is painted, so that its use can be told. */
#include <stdint.h>
#include <string.h>

#include "board.h"

extern uint32_t _data, _data_end, _data_from, _bss, _bss_end, _stack_low, _stack_top;
int main(void);
void reset(void);

enum { PAINT = 0xA5A5A5, TIMER_0 = 8 };

void reset(void)
{
    memcpy(&_data, &_data_from, (size_t)((char *)&_data_end - (char *)&_data));
    memset(&_bss, 0, (size_t)((char *)&_bss_end - (char *)&_bss));
    for (uint32_t *at = &_stack_low; at < (uint32_t *)__builtin_frame_address(0) - 16; at++)
        *at = PAINT;
    main();
    for (;;)
        continue;
}

uint32_t stack_used(void)
{
    const uint32_t *at = &_stack_low;
    while (at < &_stack_top && *at == PAINT)
        at++;
    return (uint32_t)((const char *)&_stack_top - (const char *)at);
}

static void fault(void)
{
    for (;;)
        continue;
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16 + 16])(void) = {
    (void (*)(void))&_stack_top, reset, fault, fault, fault, fault, fault, 0, 0, 0, 0, fault, fault, 0, fault, fault, [16 + TIMER_0] = timer_interrupt,
};
