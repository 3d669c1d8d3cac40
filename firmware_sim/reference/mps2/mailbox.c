/* A line in lock-step with a host in virtual time, through memory that the emulator shares with it: the device's time stands still while the host
 * works, and idle time is skipped. tests/instruments/qemu_link.py is the other end. */
#include "board.h"

enum { RING_BYTES = 1 << 20, MARGIN = 1000 }; /* ticks before an event that are not skipped: more than LEAD */

static volatile struct mail {
    uint32_t go, done, in_put, in_got, out_put, out_got;
    uint64_t until, now;
    uint8_t in[RING_BYTES], out[RING_BYTES];
} *const mail = (volatile struct mail *)0x21C00000u;

size_t line_read(uint8_t *bytes, size_t room)
{
    size_t got = 0;
    for (; got < room && mail->in_got != mail->in_put; mail->in_got = mail->in_got + 1)
        bytes[got++] = mail->in[mail->in_got % RING_BYTES];
    return got;
}

size_t line_write(const uint8_t *bytes, size_t count)
{
    size_t put = 0;
    for (; put < count && mail->out_put - mail->out_got < RING_BYTES; mail->out_put = mail->out_put + 1)
        mail->out[mail->out_put % RING_BYTES] = bytes[put++];
    return put;
}

void line_wait(uint64_t next)
{
    if (mail->in_put != mail->in_got)
        return;
    __asm volatile("cpsid i" ::: "memory");
    uint64_t now = tick();
    if (now >= mail->until || mail->out_put != mail->out_got) {
        mail->now = now;
        mail->done = mail->go;
        while (mail->done == mail->go)
            continue;
        line_offset -= tick() - now;
    }
    uint64_t wake = next < mail->until ? next : mail->until;
    if (mail->in_put == mail->in_got && wake > now + MARGIN)
        line_offset += wake - now - MARGIN;
    timer_interrupt(); /* at once, or later: the timer has run on */
    __asm volatile("cpsie i" ::: "memory");
}

void line_report(void)
{
}
