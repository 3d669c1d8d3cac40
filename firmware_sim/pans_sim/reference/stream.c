/* The stream: blocks, marks, the receive window and the buffer (protocol.md, section 5). */
#include <string.h>

#include "internal.h"

void stream_restart(struct pans_device *d)
{
    struct stream *s = &d->stream;
    bool begun = d->sending == OF_STREAM || d->sending == OF_FORGOTTEN;
    ring_forget(&s->ring, begun); /* a frame that has left in part is sent to its end */
    if (begun)
        d->sending = OF_FORGOTTEN;
    s->sequence = s->held = s->drops = 0;
    s->block.count = 0;
}

bool stream_may_send(const struct pans_device *d)
{
    const struct stream *s = &d->stream;
    uint32_t ahead = s->limit - (s->sequence - s->held); /* modulo 2^32 */
    return s->held != 0 && ahead != 0 && ahead < 0x80000000u;
}

/* Number a message and hold it, or drop it whole; its drops are those of before. */
static void put(struct pans_device *d, uint8_t *body, uint32_t bytes, enum message type, uint32_t exposures)
{
    struct stream *s = &d->stream;
    put32(body + HEADER_BYTES, s->sequence);
    if (s->held >= d->limits.buffer_messages || !ring_put_frame(&s->ring, body, bytes, type, d->session)) {
        d->counters.dropped_messages++;
        s->drops += exposures;
        return;
    }
    s->sequence++;
    s->held++;
}

/* While a block is made its bits stand behind room for as many stamps as the plan's blocks have. */
static uint8_t *bits_of(struct pans_device *d)
{
    return d->stream.block.body + HEADER_BYTES + BLOCK_HEADER + 2u * d->plan.block_exposures;
}

void stream_add(struct pans_device *d, const struct ended *ended)
{
    struct block *b = &d->stream.block;
    const uint8_t *word = (const uint8_t *)(ended + 1);
    uint8_t *at = b->body + HEADER_BYTES + BLOCK_HEADER;
    if (b->count == 0) {
        b->tick = ended->began;
        b->exposure = d->run.place.number;
        b->object = d->run.place.object;
    }
    if (d->plan.mode == 0) {
        put16(at + 2u * b->count, ended->stamp);
        uint8_t *bits = bits_of(d) + b->count / 8;
        *bits = (uint8_t)((b->count % 8 == 0 ? 0 : *bits) | (word[0] & 1) << b->count % 8);
    } else {
        memcpy(at + (uint32_t)b->count * d->edges.word_bytes, word, d->edges.word_bytes);
    }
    b->count++;
}

void stream_close_block(struct pans_device *d)
{
    struct block *b = &d->stream.block;
    uint32_t n = b->count;
    if (n == 0)
        return;
    bool frames = d->plan.mode == 1;
    uint16_t bytes = frames ? word_bytes(d->plan.n_patterns) : 0;
    uint32_t data_bytes = frames ? n * bytes : 2 * n + (n + 7) / 8;
    uint8_t *at = b->body + HEADER_BYTES;
    put32(at + 4, d->stream.drops);
    put64(at + 8, b->tick);
    put64(at + 16, b->exposure);
    put32(at + 24, d->plan.period_ticks);
    put16(at + 28, (uint16_t)n);
    put16(at + 30, bytes);
    put32(at + 32, b->object);
    if (!frames)
        memmove(at + BLOCK_HEADER + 2 * n, bits_of(d), (n + 7) / 8);
    put(d, b->body, HEADER_BYTES + BLOCK_HEADER + data_bytes, frames ? FRAMES : CLICKS, n);
    b->count = 0;
}

void stream_mark(struct pans_device *d, uint32_t object, uint64_t exposure, uint64_t tick)
{
    uint8_t body[HEADER_BYTES + 32 + CRC_BYTES], *at = body + HEADER_BYTES;
    int16_t truth = -1;
    float photons = 0;
    if (!d->hw.mark(d->hw.self, object, &truth, &photons))
        return;
    uint32_t real;
    memcpy(&real, &photons, sizeof real);
    put32(at + 4, object);
    put16(at + 8, (uint16_t)truth);
    put16(at + 10, 0); /* half: the object stands still */
    put64(at + 12, exposure);
    put64(at + 20, tick);
    put32(at + 28, real);
    put(d, body, HEADER_BYTES + 32, MARK, 0);
}
