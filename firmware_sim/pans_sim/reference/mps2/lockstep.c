/* A line in lock-step with a host in virtual time, through two pipes that the emulator opens for us (Arm semihosting): the device's time stands
 * still while the host works, and idle time is skipped. The host's words are u64 tick until which it waits, u32 n and n bytes; ours u64 tick, u32 n
 * and n bytes. tests/instruments/qemu_link.py is the other end. */
#include <string.h>

#include "../bytes.h"
#include "board.h"

enum { OPEN = 0x01, WRITE = 0x05, READ = 0x06, FOR_READING = 1, FOR_WRITING = 5 };
enum { HEAD = 12, ROOM = 1 << 19, MARGIN = 600 }; /* MARGIN: ticks before an event that are not skipped, more than LEAD */

__attribute__((section(".bench"))) static uint8_t in[ROOM], out[HEAD + ROOM];
static uint32_t in_got, in_count, out_count, pipe_in, pipe_out;
static uint64_t until;

/* Semihosting: the arguments are pointers and numbers of 32 bits. */
static uint32_t ask(uint32_t operation, uint32_t first, uint32_t second, uint32_t third)
{
    uint32_t block[3] = {first, second, third};
    register uint32_t r0 __asm("r0") = operation;
    register uint32_t *r1 __asm("r1") = block;
    __asm volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static uint32_t address(const void *at)
{
    return (uint32_t)(uintptr_t)at;
}

/* Both answer how many bytes are left to do. */
static void put_all(const uint8_t *at, uint32_t count)
{
    for (uint32_t left = count; left != 0;)
        left = ask(WRITE, pipe_out, address(at + count - left), left);
}

static void get_all(uint8_t *at, uint32_t count)
{
    for (uint32_t left = count; left != 0;)
        left = ask(READ, pipe_in, address(at + count - left), left);
}

static void exchange(uint64_t now)
{
    uint8_t head[HEAD];
    if (pipe_in == 0) {
        pipe_in = ask(OPEN, address("in"), FOR_READING, 2);
        pipe_out = ask(OPEN, address("out"), FOR_WRITING, 3);
    } else {
        put64(out, now);
        put32(out + 8, out_count);
        put_all(out, HEAD + out_count);
    }
    get_all(head, HEAD);
    until = get64(head);
    in_count = get32(head + 8);
    in_got = out_count = 0;
    get_all(in, in_count);
}

size_t line_read(uint8_t *bytes, size_t room)
{
    size_t left = in_count - in_got, got = left < room ? left : room;
    memcpy(bytes, in + in_got, got);
    in_got += (uint32_t)got;
    return got;
}

size_t line_write(const uint8_t *bytes, size_t count)
{
    size_t left = ROOM - out_count, put = left < count ? left : count;
    memcpy(out + HEAD + out_count, bytes, put);
    out_count += (uint32_t)put;
    return put;
}

void line_wait(uint64_t next)
{
    if (in_got != in_count)
        return;
    __asm volatile("cpsid i" ::: "memory");
    uint64_t now = tick(), offset = line_offset;
    if (now >= until || out_count != 0) {
        exchange(now);
        line_offset -= tick() - now;
    }
    uint64_t wake = next < until ? next : until;
    if (in_got == in_count && wake > now + MARGIN)
        line_offset += wake - now - MARGIN;
    if (line_offset != offset)
        timer_interrupt(); /* at once, or later: the timer has run on */
    __asm volatile("cpsie i" ::: "memory");
}

void line_report(void)
{
}
