/* A Pico on a bench, emulated by rp2040js: image in flash, a projector on SPI 0, photons as edges on GPIO 5, every edge of light and gate in ns.
 * It runs in lock-step with a host over stdin and stdout, all numbers little-endian:
 *   'W' u32 n, bytes   write to USB
 *   'R' u64 ns         run until bytes have come or this emulated time; answer u64 now, u32 n, bytes
 *   'L'                answer u32 n, JSON: edges, and what the bench has seen
 * node bench.mjs RP2040JS BOOTROM IMAGE SCENE; BOOTROM is rp2040js's demo/bootrom.ts. What the emulator leaves out is here, as the RP2040 datasheet
 * has it: PIO is stepped with every cycle of the processor, the flash answers on its bus, the watchdog restarts the chip. */
import fs from 'fs';
import path from 'path';
import { pathToFileURL } from 'url';

const [library, romFile, imageFile, sceneFile] = process.argv.slice(2);
const { RP2040, USBCDC, ConsoleLogger, LogLevel } = await import(pathToFileURL(path.join(library, 'dist/esm/index.js')));
const { SimulationClock } = await import(pathToFileURL(path.join(library, 'dist/esm/clock/simulation-clock.js')));
const rom = new Uint32Array(fs.readFileSync(romFile, 'utf8').match(/0x[0-9a-f]{1,8}/gi).map(Number));
const CYCLE_NS = 8, LIGHT = 2, GATE = 3, PULSES = 5, MB = 1 << 20;
const flash = new Uint8Array(2 * MB).fill(0xff);
flash.set(fs.readFileSync(imageFile));
const scene = fs.readFileSync(sceneFile); // u32 objects, pixels, slots of a walk, peak and dark counts in mHz; then bytes
const [objects, pixels, slots, peak, darkRate] = [0, 4, 8, 12, 16].map((at) => scene.readUInt32LE(at));
const edges = [];
let starts = 0;

/* -- the flash chip: commands of a W25Q16 -- */
class Flash {
  rx = []; command = []; write = false; selected = false;
  select() { this.command = []; this.selected = true; }
  deselect() {
    this.selected = false;
    const [what] = this.command, at = (this.command[1] << 16 | this.command[2] << 8 | this.command[3]) % flash.length;
    if (what === 0x06) this.write = true;
    if (this.write && what === 0x20) flash.fill(0xff, at & ~4095, (at & ~4095) + 4096);
    if (this.write && what === 0xd8) flash.fill(0xff, at & ~65535, (at & ~65535) + 65536);
    if (this.write && what === 0x02) this.command.slice(4).forEach((byte, i) => { flash[(at & ~255) + ((at + i) & 255)] &= byte; });
    if (what !== 0x06 && this.command.length) this.write = what === 0x05 ? this.write : false;
  }
  exchange(byte) {
    if (!this.selected) return byte === 0x35 ? 2 : 0; // stage 2 of the boot, whose bus selects by itself: quad mode is on, nothing is busy
    this.command.push(byte & 255);
    const n = this.command.length;
    if (this.command[0] === 0x4b && n > 5) return [0xe6, 0x60, 0x58, 0x38, 0x83, 0x1c, 0x4a, 0x2b][(n - 6) % 8];
    return this.command[0] === 0x05 ? (this.write ? 2 : 0) : 0xff;
  }
}

function powerOn(nanos) {
  const clock = new SimulationClock(), mcu = new RP2040(clock), chip = new Flash();
  clock.nanosCounter = nanos;
  starts++;
  mcu.logger = new ConsoleLogger(LogLevel.Error, false);
  mcu.loadBootrom(rom);
  mcu.flash.set(flash, 0);
  mcu.core.PC = 0x10000000;
  mcu.gpio[PULSES].padValue = 0x56; // what the chip resets to: input enabled
  /* flash: its bus, and the chip select that the boot ROM overrides */
  const ssi = mcu.peripherals[0x18000], qspi = mcu.peripherals[0x40018];
  const ssiRead = ssi.readUint32.bind(ssi), ssiWrite = ssi.writeUint32.bind(ssi);
  ssi.readUint32 = (offset) => {
    if (offset === 0x24) return chip.rx.length;
    if (offset === 0x28) return 6 | (chip.rx.length ? 8 : 0);
    return offset === 0x60 ? chip.rx.shift() ?? 0 : ssiRead(offset);
  };
  ssi.writeUint32 = (offset, value) => {
    if (offset === 0x08 && !value) chip.rx = [];
    if (offset === 0x60) { chip.rx.push(chip.exchange(value)); return; }
    ssiWrite(offset, value);
  };
  let select = 0;
  qspi.readUint32 = (offset) => (offset === 0x0c ? select : 0);
  qspi.writeUint32 = (offset, value) => {
    if (offset !== 0x0c) return;
    const before = select >> 8 & 3, after = value >> 8 & 3;
    select = value;
    if (after === 2 && before !== 2) chip.select();
    if (after !== 2 && before === 2) { chip.deselect(); mcu.flash.set(flash, 0); }
  };
  /* PWM inputs: the emulator tests the direction of all pins instead of this one's */
  const { pwm } = mcu;
  pwm.gpioOnInput = (index) => {
    if (pwm.gpioDirection & 1 << index) return;
    for (const channel of pwm.channels) if (channel.pinB1 === index || channel.pinB2 === index) channel.gpioBChanged();
  };
  for (const pio of mcu.pio) pio.run = () => {};
  const one = { clock, mcu, out: [], outBytes: 0, connected: false, inbox: [], bitten: false, within: 0 };
  mcu.peripherals[0x40058].onWatchdogTrigger = () => { one.bitten = true; };
  projector(one);
  detector(one);
  const cdc = new USBCDC(mcu.usbCtrl);
  cdc.onDeviceConnected = () => { one.connected = true; };
  cdc.onSerialData = (data) => { one.out.push(data.slice()); one.outBytes += data.length; };
  one.cdc = cdc;
  return one;
}

/* -- projector and detector -- */
const masks = [];
let chosen = 0xffff, exposure = -1, seed = 1n, clicks = 0;
function chance() {
  seed = seed * 6364136223846793005n + 1442695040888963407n & 0xffffffffffffffffn;
  return Number(seed >> 11n) / 2 ** 53;
}
function wait(rate) { return -Math.log(1 - chance()) / rate * 1e9; }
function projector({ mcu }) {
  let message = [], need = 1;
  mcu.spi[0].onTransmit = (byte) => {
    message.push(byte);
    if (message.length === need) {
      const what = String.fromCharCode(message[0]), n = message[5] | message[6] << 8;
      if (need === 1 && what !== 'F') need = what === 'P' ? 8 : 3;
      else if (what === 'P' && need === 8) need = 8 + (message[7] ? n + 7 >> 3 : 2 * n);
      else {
        const pattern = message[1] | message[2] << 8, first = message[3] | message[4] << 8;
        if (what === 'C') chosen = pattern;
        if (what === 'P') {
          masks[pattern] ??= new Uint8Array(pixels);
          for (let i = 0; i < n; i++) masks[pattern][first + i] = message[7] ? message[8 + (i >> 3)] >> (i & 7) & 1 : message[8 + 2 * i] ? 1 : 0;
        }
        message = []; need = 1;
      }
    }
    mcu.spi[0].completeTransmit(0);
  };
}
function detector(one) {
  const { mcu, clock } = one;
  let lit = false, open = false, rate = 0;
  /* light and dark clicks are two processes, each begun anew where its cause begins: exponential waits forget */
  const click = () => { clicks++; mcu.gpio[PULSES].setInputValue(true); mcu.gpio[PULSES].setInputValue(false); };
  const photon = clock.createAlarm(() => { click(); photon.schedule(wait(rate)); });
  const dark = clock.createAlarm(() => { click(); dark.schedule(wait(darkRate / 1000)); });
  const now = () => clock.nanos + one.within;
  mcu.gpio[LIGHT].addListener((state) => {
    if (state > 1 || (state === 1) === lit) return;
    lit = state === 1;
    edges.push(['light', +lit, now()]);
    photon.cancel();
    if (!lit) return;
    const mask = masks[chosen], object = Math.floor((exposure + !open) / slots) % objects;
    let sum = 0;
    if (mask) for (let i = 0; i < pixels; i++) sum += mask[i] * scene[20 + object * pixels + i];
    rate = sum / 255 * peak / 1000;
    if (rate > 0) photon.schedule(wait(rate));
  });
  mcu.gpio[GATE].addListener((state) => {
    if (state > 1 || (state === 1) === open) return;
    open = state === 1;
    exposure += open;
    edges.push(['gate', +open, now()]);
    dark.cancel();
    if (open) dark.schedule(wait(darkRate / 1000));
  });
  one.off = () => { for (const [name, on] of [['light', lit], ['gate', open]]) if (on) edges.push([name, 0, clock.nanos]); };
}

/* -- running -- */
let one = powerOn(0);
function step() {
  const { mcu, clock } = one;
  const cycles = mcu.core.waiting ? 8 : mcu.core.executeInstruction();
  for (const pio of mcu.pio) {
    if (pio.stopped) continue;
    for (let i = 0; i < cycles; i++) {
      one.within = i * CYCLE_NS;
      for (const machine of pio.machines) if (machine.enabled) machine.step();
      pio.checkChangedPins();
    }
  }
  one.within = 0;
  clock.tick(cycles * CYCLE_NS);
  if (one.bitten) {
    one.off(); // pins are inputs that are pulled down, at once
    edges.push(['watchdog', 1, clock.nanos]);
    exposure = -1;
    one = powerOn(clock.nanos);
  }
}
function run(until, stop) {
  while (one.clock.nanos < until && !stop()) {
    while (one.inbox.length && one.cdc.txFIFO.itemCount < 500) one.cdc.sendSerialByte(one.inbox.shift());
    for (let i = 0; i < 64 && !stop(); i++) step();
  }
}
function connect() {
  run(one.clock.nanos + 3e9, () => one.connected);
  run(one.clock.nanos + 5e6, () => false);
}
connect();
process.stderr.write(`connected ${one.connected} after ${one.clock.nanos / 1e6} ms\n`);

/* -- requests -- */
function take(n) {
  const b = Buffer.alloc(n);
  for (let at = 0; at < n; ) { const got = fs.readSync(0, b, at, n - at, null); if (got === 0) process.exit(0); at += got; }
  return b;
}
function put(b) { for (let at = 0; at < b.length; ) at += fs.writeSync(1, b, at); }
for (;;) {
  const what = String.fromCharCode(take(1)[0]);
  if (what === 'W') for (const byte of take(take(4).readUInt32LE(0))) one.inbox.push(byte);
  else if (what === 'R') {
    const until = Number(take(8).readBigUInt64LE(0));
    if (!one.connected) connect();
    run(until, () => one.outBytes > 0);
    const data = Buffer.concat(one.out), head = Buffer.alloc(12);
    one.out = []; one.outBytes = 0;
    head.writeBigUInt64LE(BigInt(Math.round(one.clock.nanos)), 0); head.writeUInt32LE(data.length, 8);
    put(Buffer.concat([head, data]));
  } else {
    const text = Buffer.from(JSON.stringify({ edges, clicks, starts })), head = Buffer.alloc(4);
    head.writeUInt32LE(text.length, 0); put(Buffer.concat([head, text]));
  }
}
