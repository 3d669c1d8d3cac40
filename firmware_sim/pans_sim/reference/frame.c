/* See frame.h. COBS: Cheshire and Baker, "Consistent overhead byte stuffing" (1999). */
#include "frame.h"

#include <string.h>

#include "bytes.h"

static uint32_t crc_start(uint8_t type)
{
    return type == HELLO || type == WELCOME ? 0 : PANS_SCHEMA; /* readable across versions, so that a mismatch can be named */
}

void decoder_init(struct decoder *decoder, uint8_t *body, uint32_t room)
{
    memset(decoder, 0, sizeof *decoder);
    decoder->body = body;
    decoder->room = room;
}

static bool is_whole(const struct decoder *decoder)
{
    uint32_t count = decoder->count;
    if (decoder->skipping || decoder->left != 0 || count < HEADER_BYTES + CRC_BYTES)
        return false;
    count -= CRC_BYTES;
    return pans_crc32(crc_start(decoder->body[0]), decoder->body, count) == get32(decoder->body + count);
}

static void append(struct decoder *decoder, uint8_t byte)
{
    if (decoder->count == decoder->room)
        decoder->skipping = true;
    else
        decoder->body[decoder->count++] = byte;
}

enum arrival decoder_take(struct decoder *decoder, uint8_t byte, uint32_t *count)
{
    if (byte == 0) {
        bool empty = decoder->code == 0, whole = !empty && is_whole(decoder);
        *count = decoder->count;
        decoder->count = 0;
        decoder->code = decoder->left = 0;
        decoder->skipping = false;
        return whole ? FRAME : empty ? NOTHING : DAMAGED;
    }
    if (decoder->skipping)
        return NOTHING;
    if (decoder->left != 0) {
        append(decoder, byte);
        decoder->left--;
        return NOTHING;
    }
    if (decoder->code != 0 && decoder->code != 0xFF)
        append(decoder, 0); /* between two groups; that of the last one is not part of the data */
    decoder->code = byte;
    decoder->left = (uint8_t)(byte - 1);
    return NOTHING;
}

void ring_init(struct ring *ring, uint8_t *at, uint32_t size)
{
    memset(ring, 0, sizeof *ring);
    ring->at = at;
    ring->size = size;
}

static uint32_t wrapped(const struct ring *ring, uint32_t place)
{
    return place >= ring->size ? place - ring->size : place;
}

bool ring_has_room(const struct ring *ring, uint32_t count)
{
    uint32_t data = count + CRC_BYTES;
    return ring->size - ring->used >= data + data / 254 + 2;
}

bool ring_put_frame(struct ring *ring, uint8_t *body, uint32_t count, enum message type, uint32_t session)
{
    if (!ring_has_room(ring, count))
        return false;
    put32(body, (uint32_t)type); /* flags and the reserved bytes are 0 */
    put32(body + 4, session);
    put32(body + count, pans_crc32(crc_start((uint8_t)type), body, count));
    uint32_t code_at = wrapped(ring, ring->first + ring->used), at = wrapped(ring, code_at + 1), written = 1;
    uint8_t code = 1;
    for (uint32_t i = 0; i < count + CRC_BYTES; i++) {
        if (body[i] != 0) {
            ring->at[at] = body[i];
            at = wrapped(ring, at + 1);
            written++;
            code++;
        }
        if (body[i] == 0 || code == 0xFF) {
            ring->at[code_at] = code;
            code_at = at;
            at = wrapped(ring, at + 1);
            written++;
            code = 1;
        }
    }
    ring->at[code_at] = code;
    ring->at[at] = 0;
    ring->used += written + 1;
    return true;
}

/* How many bytes the first frame has, or still has. */
static uint32_t frame_bytes(const struct ring *ring)
{
    uint32_t straight = ring->size - ring->first;
    straight = ring->used < straight ? ring->used : straight;
    const uint8_t *start = ring->at + ring->first, *end = memchr(start, 0, straight);
    if (end != NULL)
        return (uint32_t)(end - start) + 1;
    end = memchr(ring->at, 0, ring->used - straight);
    return end == NULL ? 0 : straight + (uint32_t)(end - ring->at) + 1;
}

uint32_t ring_take(struct ring *ring, uint8_t *out, size_t room, bool *ended)
{
    uint32_t whole = ring->used == 0 ? 0 : frame_bytes(ring), count = whole;
    if (count > room)
        count = (uint32_t)room;
    uint32_t straight = ring->size - ring->first;
    straight = count < straight ? count : straight;
    memcpy(out, ring->at + ring->first, straight);
    memcpy(out + straight, ring->at, count - straight);
    ring->first = wrapped(ring, ring->first + count);
    ring->used -= count;
    *ended = count == whole && count != 0;
    return count;
}

void ring_forget(struct ring *ring, bool begun)
{
    ring->used = begun ? frame_bytes(ring) : 0;
}
