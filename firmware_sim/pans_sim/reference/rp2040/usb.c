/* The port: USB CDC through TinyUSB, and its descriptors. Vendor and product are those of the vendor's own CDC example. */
#include <string.h>

#include "board.h"
#include "tusb.h"

enum { VENDOR = 0x2E8A, PRODUCT = 0x000A, RELEASE = 0x0200, MILLIAMPERES = 250 };
enum { CONTROL, DATA, INTERFACES };
enum { NOTIFY_IN = 0x81, DATA_OUT = 0x02, DATA_IN = 0x82, NOTIFY_BYTES = 8, DATA_BYTES = 64 };
enum { LANGUAGE, MANUFACTURER, NAME, SERIAL, PORT, TEXTS };
#define CONFIGURATION_BYTES (TUD_CONFIG_DESC_LEN + TUD_CDC_DESC_LEN)

static const char *text[TEXTS] = {"", "PANS", "PANS instrument", "", "PANS protocol"};

void port_start(const char *serial)
{
    text[SERIAL] = serial;
    tusb_init();
}

size_t port_read(uint8_t *bytes, size_t room)
{
    tud_task();
    return tud_cdc_read(bytes, (uint32_t)room);
}

size_t port_write(const uint8_t *bytes, size_t count)
{
    uint32_t took = count == 0 ? 0 : tud_cdc_write(bytes, (uint32_t)count);
    if (took != 0)
        tud_cdc_write_flush(); /* a short frame is one that the host waits for */
    return took;
}

uint8_t const *tud_descriptor_device_cb(void)
{
    static const tusb_desc_device_t device = {
        .bLength = sizeof device,
        .bDescriptorType = TUSB_DESC_DEVICE,
        .bcdUSB = 0x0200,
        .bDeviceClass = TUSB_CLASS_MISC,
        .bDeviceSubClass = MISC_SUBCLASS_COMMON,
        .bDeviceProtocol = MISC_PROTOCOL_IAD,
        .bMaxPacketSize0 = CFG_TUD_ENDPOINT0_SIZE,
        .idVendor = VENDOR,
        .idProduct = PRODUCT,
        .bcdDevice = RELEASE,
        .iManufacturer = MANUFACTURER,
        .iProduct = NAME,
        .iSerialNumber = SERIAL,
        .bNumConfigurations = 1,
    };
    return (uint8_t const *)&device;
}

uint8_t const *tud_descriptor_configuration_cb(uint8_t index)
{
    static const uint8_t configuration[] = {
        TUD_CONFIG_DESCRIPTOR(1, INTERFACES, 0, CONFIGURATION_BYTES, 0, MILLIAMPERES),
        TUD_CDC_DESCRIPTOR(CONTROL, PORT, NOTIFY_IN, NOTIFY_BYTES, DATA_OUT, DATA_IN, DATA_BYTES),
    };
    (void)index;
    return configuration;
}

uint16_t const *tud_descriptor_string_cb(uint8_t index, uint16_t language)
{
    static uint16_t words[32];
    size_t count = 1;
    (void)language;
    if (index >= TEXTS)
        return NULL;
    words[1] = 0x0409; /* English */
    if (index != LANGUAGE)
        for (count = 0; text[index][count] != '\0' && count < 31; count++)
            words[1 + count] = (uint8_t)text[index][count];
    words[0] = (uint16_t)(TUSB_DESC_STRING << 8 | (2 * count + 2));
    return words;
}
