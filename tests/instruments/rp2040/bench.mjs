/* A Pico on a bench, emulated by rp2040js: image in flash, a projector on SPI 0, photons as edges on GPIO 5, every edge of light and gate in ns.
 * It runs in lock-step with a host over stdin and stdout, all numbers little-endian; time passes in 'R' alone:
 *   'W' u32 n, bytes              write to USB
 *   'R' u64 ns                    run until bytes have come, the chip has restarted or is there for the first time, or that emulated time;
 *                                 answer u64 now, u8 is the port there?, u32 n, bytes
 *   'H' u32 n, u32 at, u16 code   when the n-th exposure from now on begins, write an instruction into RAM: so a loop hangs
 *   'L'                           answer u32 n, JSON: edges, and what the bench has seen
 * node bench.mjs RP2040JS BOOTROM IMAGE SCENE; BOOTROM is rp2040js's demo/bootrom.ts.
 *
 * What the emulator leaves out is here, as the RP2040 datasheet has it: PIO turns with every cycle of the processor, a pin can be read back, the
 * flash chip answers on its bus, the watchdog restarts all of the chip but its REASON and SCRATCH. Not emulated: waits for flash and buses; and
 * what an instruction writes reaches PIO up to 3 cycles (24 ns) early. */
import fs from 'fs';
import path from 'path';
import { pathToFileURL } from 'url';

const [library, romFile, imageFile, sceneFile] = process.argv.slice(2);
const { RP2040, USBCDC, BasePeripheral, ConsoleLogger, LogLevel } = await import(pathToFileURL(path.join(library, 'dist/esm/index.js')));
const rom = new Uint32Array(fs.readFileSync(romFile, 'utf8').match(/0x[0-9a-f]{1,8}/gi).map(Number));
const CYCLE_NS = 8, LIGHT = 2, GATE = 3, PULSES = 5, PULSE_NS = 40, RAM = 0x20000000;
const NAMES = { [LIGHT]: 'light', [GATE]: 'gate', [PULSES]: 'pulse', 6: 'output 0', 7: 'output 1', 8: 'output 2', 9: 'output 3' };
const flash = new Uint8Array(2 << 20).fill(0xff);
flash.set(fs.readFileSync(imageFile));
const scene = fs.readFileSync(sceneFile); // u32 objects, pixels, slots of a walk, peak and dark counts in mHz; then bytes
const [objects, pixels, slots, peak, darkRate] = [0, 4, 8, 12, 16].map((at) => scene.readUInt32LE(at));

/* -- the flash chip: commands of a W25Q16, on a bus whose chip select the boot ROM overrides -- */
const UNIQUE = [0xe6, 0x60, 0x58, 0x38, 0x83, 0x1c, 0x4a, 0x2b];
class Flash extends BasePeripheral {
  kept = {}; received = []; command = []; enabled = false; selected = false;
  constructor(mcu) { super(mcu, 'SSI'); }
  select(on) {
    if (this.selected && !on) this.execute();
    this.selected = on;
  }
  execute() {
    const [what, high, middle, low, ...data] = this.command, at = (high << 16 | middle << 8 | low) % flash.length;
    if (this.enabled && what === 0x02) data.forEach((byte, i) => { flash[(at & ~255) + ((at + i) & 255)] &= byte; });
    if (this.enabled && what === 0x20) flash.fill(0xff, at & ~4095, (at & ~4095) + 4096);
    if (this.enabled && what === 0xd8) flash.fill(0xff, at & ~65535, (at & ~65535) + 65536);
    if (what === 0x02 || what === 0x20 || what === 0xd8) this.rp2040.flash.set(flash);
    this.enabled = what === 0x06 || (this.enabled && what === 0x05);
    this.command = [];
  }
  exchange(byte) {
    if (!this.selected) return 0; // stage 2 of the boot, whose bus selects by itself: nothing is busy
    this.command.push(byte & 255);
    if (this.command[0] === 0x4b && this.command.length > 5) return UNIQUE[(this.command.length - 6) % 8];
    return this.command[0] === 0x05 && this.enabled ? 2 : 0;
  }
  readUint32(offset) {
    if (offset === 0x24) return this.received.length;
    if (offset === 0x28) return 6 | (this.received.length ? 8 : 0);
    return offset === 0x60 ? this.received.shift() ?? 0 : this.kept[offset] ?? 0;
  }
  writeUint32(offset, value) {
    this.kept[offset] = value;
    if (offset === 0x08 && !value) this.received = [];
    if (offset === 0x60) this.received.push(this.exchange(value));
  }
}
class Select extends BasePeripheral {
  kept = {};
  constructor(mcu, chip) { super(mcu, 'IO_QSPI'); this.chip = chip; }
  readUint32(offset) { return this.kept[offset] ?? 0; }
  writeUint32(offset, value) {
    this.kept[offset] = value;
    if (offset === 0x0c) this.chip.select((value >> 8 & 3) === 2);
  }
}

/* -- projector and detector -- */
const masks = new Map(), edges = [], level = {};
let chosen = 0xffff, exposure = -1, exposures = 0, starts = 0, seed = 1n, hang = null;
function chance() {
  seed = seed * 6364136223846793005n + 1442695040888963407n & 0xffffffffffffffffn;
  return (Number(seed >> 11n) + 1) / 2 ** 53;
}
function wait(rate) { return Math.max(1, -Math.log(chance()) / rate * 1e9); }
function projector(mcu) {
  const [spi] = mcu.spi, sent = mcu.clock.createAlarm(() => spi.completeTransmit(0));
  let message = [], need = 1;
  spi.onTransmit = (byte) => {
    sent.schedule(8e9 / spi.clockFrequency);
    message.push(byte);
    if (message.length === need) {
      const what = String.fromCharCode(message[0]), n = message[5] | message[6] << 8;
      if (need === 1 && what !== 'F') need = what === 'P' ? 8 : 3;
      else if (what === 'P' && need === 8) need = 8 + (message[7] ? n + 7 >> 3 : 2 * n);
      else {
        const pattern = message[1] | message[2] << 8, first = message[3] | message[4] << 8;
        if (what === 'F') masks.clear();
        if (what === 'C') chosen = pattern;
        if (what === 'P') {
          const mask = masks.get(pattern) ?? masks.set(pattern, new Uint8Array(pixels)).get(pattern);
          for (let i = 0; i < n; i++) mask[first + i] = message[7] ? message[8 + (i >> 3)] >> (i & 7) & 1 : message[8 + 2 * i] ? 1 : 0;
        }
        message = []; need = 1;
      }
    }
  };
}
function brightness() {
  const mask = masks.get(chosen), object = Math.floor((exposure + !level[GATE]) / slots) % objects;
  let sum = 0;
  if (mask) for (let i = 0; i < pixels; i++) sum += mask[i] * scene[20 + object * pixels + i];
  return sum / 255 * peak / 1000;
}
/* Light and dark clicks are two processes, each begun anew where its cause begins: exponential waits forget. */
function detector(mcu) {
  const pin = mcu.gpio[PULSES], { began } = one;
  const pulse = (on) => { pin.setInputValue(on === 1); note(PULSES, on, began + mcu.clock.nanos); };
  const fall = mcu.clock.createAlarm(() => pulse(0));
  const click = () => { pulse(1); fall.schedule(PULSE_NS); };
  let rate = 0;
  const photon = mcu.clock.createAlarm(() => { click(); photon.schedule(wait(rate)); });
  const dark = mcu.clock.createAlarm(() => { click(); dark.schedule(wait(darkRate / 1000)); });
  return (which, on) => {
    if (which === LIGHT) {
      photon.cancel();
      rate = on ? brightness() : 0;
      if (rate > 0) photon.schedule(wait(rate));
    } else if (which === GATE) {
      dark.cancel();
      if (on) dark.schedule(wait(darkRate / 1000));
    }
  };
}

/* -- the chip -- */
let one = null;
function note(pin, on, at) {
  if ((level[pin] ?? 0) === on) return;
  level[pin] = on;
  edges.push([NAMES[pin], on, Math.round(at)]);
}
function powerOn(began, before) {
  const mcu = new RP2040(), chip = new Flash(mcu), [pio] = mcu.pio, watchdog = mcu.peripherals[0x40058];
  for (const pin in NAMES) note(pin, 0, began); // inputs that are pulled down
  starts++;
  exposure = -1;
  one = { mcu, pio, began, edge: began, out: [], inbox: [], connected: false, bitten: false };
  mcu.logger = new ConsoleLogger(LogLevel.Error, false);
  mcu.loadBootrom(rom);
  mcu.flash.set(flash);
  mcu.core.PC = 0x10000000;
  mcu.peripherals[0x18000] = chip;
  mcu.peripherals[0x40018] = new Select(mcu, chip);
  if (before) { watchdog.reason = before.reason; watchdog.scratchData.set(before.scratchData); }
  watchdog.onWatchdogTrigger = () => { one.bitten = true; watchdog.alarm.enable = false; }; // once
  for (const block of mcu.pio) block.run = () => {}; // turn() does it
  projector(mcu);
  const changed = detector(mcu), here = one;
  for (const pin of Object.keys(NAMES).map(Number).filter((at) => at !== PULSES))
    mcu.gpio[pin].addListener((state) => {
      const on = +(state === 1);
      mcu.gpio[pin].setInputValue(on === 1);
      note(pin, on, pin > GATE ? began + mcu.clock.nanos : here.edge);
      if (pin === GATE && on) {
        exposure++;
        exposures++;
        if (hang?.at === exposures) mcu.sramView.setUint16(hang.address - RAM, hang.code, true);
      }
      changed(pin, on);
    });
  here.cdc = new USBCDC(mcu.usbCtrl);
  here.cdc.onDeviceConnected = () => { here.connected = true; };
  here.cdc.onSerialData = (data) => here.out.push(data.slice());
}
/* The state machines of PIO, for so many cycles of the processor. */
function turn({ mcu, pio, began }, cycles) {
  const from = began + mcu.clock.nanos;
  for (const machine of pio.machines) {
    let left = machine.enabled ? cycles : 0;
    while (left > 0 && !machine.waiting) {
      if (pio.instructions[machine.pc] >>> 5 === 2 && (pio.instructions[machine.pc] & 31) === machine.pc && machine.x > 1) { // jmp x-- to itself
        const many = Math.min(machine.x - 1, left);
        machine.x -= many;
        left -= many;
        continue;
      }
      const before = machine.cycles;
      machine.step();
      left -= machine.cycles - before;
      one.edge = from + (cycles - left) * CYCLE_NS;
      pio.checkChangedPins();
    }
  }
  one.edge = from + cycles * CYCLE_NS;
}
function now() { return one.began + one.mcu.clock.nanos; }
function run(until) {
  const was = one.connected;
  while (now() < until && one.out.length === 0 && one.connected === was) {
    while (one.inbox.length && one.cdc.txFIFO.itemCount < 500) one.cdc.sendSerialByte(one.inbox.shift());
    for (let i = 0; i < 64 && !one.bitten; i++) {
      const cycles = one.mcu.core.waiting ? 8 : one.mcu.core.executeInstruction();
      turn(one, cycles);
      one.mcu.clock.tick(cycles * CYCLE_NS);
    }
    if (!one.bitten) continue;
    edges.push(['watchdog', 1, Math.round(now())]);
    powerOn(now(), one.mcu.peripherals[0x40058]);
    return;
  }
}

/* -- requests -- */
function take(n) {
  const b = Buffer.alloc(n);
  for (let at = 0; at < n; ) { const got = fs.readSync(0, b, at, n - at, null); if (got === 0) process.exit(0); at += got; }
  return b;
}
function put(b) { for (let at = 0; at < b.length; ) at += fs.writeSync(1, b, at); }
powerOn(0, null);
for (;;) {
  const what = String.fromCharCode(take(1)[0]);
  if (what === 'W') for (const byte of take(take(4).readUInt32LE(0))) one.inbox.push(byte);
  else if (what === 'H') hang = { at: exposures + take(4).readUInt32LE(0), address: take(4).readUInt32LE(0), code: take(2).readUInt16LE(0) };
  else if (what === 'R') {
    run(Number(take(8).readBigUInt64LE(0)));
    const data = Buffer.concat(one.out), head = Buffer.alloc(13);
    one.out = [];
    head.writeBigUInt64LE(BigInt(Math.round(now())), 0); head.writeUInt8(+one.connected, 8); head.writeUInt32LE(data.length, 9);
    put(Buffer.concat([head, data]));
  } else {
    const text = Buffer.from(JSON.stringify({ edges, starts, clk_sys: one.mcu.clkSys })), head = Buffer.alloc(4);
    head.writeUInt32LE(text.length, 0); put(Buffer.concat([head, text]));
  }
}
