// Devices by hand, through the same gate as a run; while a run owns the stand they take no orders.
import { get, order, tell } from "./api.js";
import { look_of } from "./channels.js";
import { fill, h, number, say, unit_of, words } from "./dom.js";
import { Faults } from "./faults.js";

export class Devices {
  constructor(place, app) {
    this.app = app;
    this.place = place;
    this.answer = h("p", { class: "answer", role: "status" });
    this.note = h("p", { class: "quiet" });
    this.cards = h("div", { class: "stack" });
    this.counters = h("dl", { class: "facts" });
    this.faulty = h("section", { class: "panel", hidden: true });
    fill(place, h("div", { class: "grid" }, h("div", { class: "stack" }, this.note, this.answer, this.cards),
      h("div", { class: "stack" }, h("section", { class: "panel" }, h("h2", {}, "What wears"), this.counters), this.faulty)));
    this.load();
    this.timer = setInterval(() => this.load(), 5000);
  }

  async load() {
    if (document.hidden || this.closed || this.app.is_lost) return;
    let devices;
    try { devices = await get("/devices"); } catch (error) { return tell(this.answer, error.message, true); }
    if (this.closed) return;
    // The inputs of somebody who is filling them in stay what they are.
    const shape = JSON.stringify(devices.map(({ refused, ...rest }) => rest));
    if (shape !== this.shape) {
      this.shape = shape;
      this.parts = devices.map((device) => this.card(device));
      fill(this.cards, this.parts.map((part) => part.card));
    }
    devices.forEach((device, index) => this.refuse(this.parts[index], device));
    this.refused = devices.find((device) => device.refused)?.refused;
    if (this.app.state) this.update(this.app.state);
    this.faults?.load();
  }

  card(device) {
    const values = h("dl", { class: "facts" });
    const answer = h("p", { class: "answer", role: "status" });
    const verbs = device.verbs.map((verb) => this.verb(device, verb, answer));
    return { device, values, verbs, card: h("section", { class: "panel" }, h("div", { class: "head" }, h("h2", {}, words(device.name)), device.kind === device.name ? null : h("small", {}, device.kind)), values, h("div", { class: "verbs" }, verbs), answer) };
  }

  verb(device, verb, answer) {
    const inputs = verb.arguments.map((argument) => this.input(argument));
    return h("form", { class: "row", "data-verb": verb.verb, onsubmit: (event) => {
      event.preventDefault();
      const given = Object.fromEntries(inputs.map(({ name, value }) => [name, value()]).filter(([, value]) => value !== undefined));
      order(answer, "device", { device: device.name, verb: verb.verb, arguments: given }, verb.text || words(verb.verb));
    } }, inputs.map(({ label }) => label), h("button", { type: "submit", "data-order": "device", "data-role": verb.role }, verb.text || words(verb.verb)));
  }

  input(argument) {
    const { name, unit, minimum, maximum, choices } = argument;
    if (choices?.length) {
      const select = h("select", {}, choices.map((choice) => h("option", { value: choice }, words(choice))));
      return { name, value: () => select.value, label: h("label", {}, `${words(name)} `, select) };
    }
    const is_bounded = minimum !== null && minimum !== undefined;
    const input = h("input", { type: "number", step: "any", min: minimum, max: maximum, required: true });
    const range = is_bounded ? `${number(minimum, 0)} to ${number(maximum, 0)} ` : "";
    return { name, value: () => Number(input.value), label: h("label", {}, `${words(unit ? name.replace(/_[a-zA-Z]+$/, "") : name)} `, input, h("small", {}, ` ${range}${unit_of(unit)}`)) };
  }

  refuse(part, device) {
    for (const verb of part.verbs) for (const control of verb.elements) control.disabled = Boolean(device.refused);
  }

  update(state) {
    say(this.note, this.refused ? `Devices take no orders: ${this.refused}.` : "Every order goes through the stand's own limits and interlocks, and is recorded.");
    for (const { device, values } of this.parts ?? []) {
      const rows = device.channels.filter((channel) => state.readings[channel] && !channel.endsWith("_raw"));
      const key = rows.join();
      if (values.dataset.key !== key) {
        values.dataset.key = key;
        fill(values, rows.map((channel) => [h("dt", {}, name_of(channel)), h("dd", {}, "")]));
      }
      rows.forEach((channel, index) => {
        const reading = state.readings[channel];
        const is_idle = channel === "regulator.sp" && state.setpoint_degC === null && reading.value !== null; // what the regulator remembers is nobody's wish
        say(values.children[2 * index + 1], is_idle ? "none" : reading.value === null ? `no reading: ${reading.reason}` : value_of(channel, reading));
      });
    }
    if (state.simulated && !this.faults) {
      this.faults = new Faults(this.faulty);
      this.faulty.hidden = false;
      this.faults.load();
    }
    const counters = Object.entries(state.counters);
    if (counters.length !== this.counters.children.length / 2) fill(this.counters, counters.map(([name]) => [h("dt", {}, words(name.replace(".", ", "))), h("dd", {}, "")]));
    counters.forEach(([, value], index) => say(this.counters.children[2 * index + 1], number(value, Number.isInteger(value) ? 0 : 1)));
  }

  soon() { this.load(); }
  event() {}
  close() { this.closed = true; clearInterval(this.timer); }
}

// Of a device that has a box of its own, what is read; temperatures are called as in the curves.
const name_of = (channel) => (channel.startsWith("thermometers.") || channel.startsWith("regulator.") ? look_of(channel).name.replace(/^regulator (?=[a-z])/, "") : words(channel.split(".")[1]));

function value_of(channel, { value, unit }) {
  const says = channel.startsWith("relays.") ? ["off", "on"] : /\.(running|fault|moving|homed|on_battery|low_battery)$/.test(channel) ? ["no", "yes"] : null;
  return (unit === "1" && says?.[value]) || `${number(value, Number.isInteger(value) ? 0 : 2)} ${unit_of(unit)}`;
}
