/* Frames: COBS and CRC-32 around every message, and rings of whole frames that wait to be sent (protocol.md, section 1). */
#ifndef PANS_FRAME_H
#define PANS_FRAME_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define PANS_SCHEMA 0x2E64AFC4u
#define PANS_PROTOCOL 1
#define HEADER_BYTES 8u
#define CRC_BYTES 4u
#define MAX_PAYLOAD 65536u

enum message {
    HELLO = 0x01, PING = 0x02, COMMAND = 0x03, GRANT = 0x04,
    WELCOME = 0x81, PONG = 0x82, ACK = 0x83, STATUS = 0x84, EXPOSED = 0x85, CLICKS = 0x90, FRAMES = 0x91, MARK = 0x92,
};

uint32_t pans_crc32(uint32_t start, const uint8_t *data, size_t count);

/* The receiver: bytes become the body of a frame, one after another, in a buffer of the longest one. */
struct decoder {
    uint8_t *body;
    uint32_t room, count;
    uint8_t code, left; /* of the present COBS group: its code, and how many of its bytes are to come */
    bool skipping;      /* until the next delimiter: too long */
};

enum arrival { NOTHING, DAMAGED, FRAME };

void decoder_init(struct decoder *decoder, uint8_t *body, uint32_t room);

/* Take one byte. FRAME: body[0..count - CRC_BYTES) is header and payload of a frame whose CRC is right; valid until the next byte. */
enum arrival decoder_take(struct decoder *decoder, uint8_t byte, uint32_t *count);

/* Bytes that wait to be sent: whole frames, in order. */
struct ring {
    uint8_t *at;
    uint32_t size, first, used;
};

void ring_init(struct ring *ring, uint8_t *at, uint32_t size);

/* Whether a frame around `count` bytes of header and payload fits. */
bool ring_has_room(const struct ring *ring, uint32_t count);

/* Stamp type and session on body (header, `count` - HEADER_BYTES bytes of payload, room for the CRC) and append it as a frame. False: no room. */
bool ring_put_frame(struct ring *ring, uint8_t *body, uint32_t count, enum message type, uint32_t session);

/* Take up to `room` bytes of the first frame; `ended` tells whether its delimiter was among them. */
uint32_t ring_take(struct ring *ring, uint8_t *out, size_t room, bool *ended);

/* Drop all frames; the rest of the first one stays where `begun` says that a part of it has been sent. */
void ring_forget(struct ring *ring, bool begun);

#endif
