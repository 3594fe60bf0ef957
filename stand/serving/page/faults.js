// Faults on purpose, in the simulated laboratory only: what can be broken, what is, and mending it.
import { get, order, tell } from "./api.js";
import { fill, h, say, words } from "./dom.js";

export class Faults {
  constructor(place) {
    this.name = h("select", { "aria-label": "What to break", onchange: () => this.describe() });
    this.value = h("input", { type: "text", autocomplete: "off", spellcheck: "false" });
    this.for_s = h("input", { type: "number", min: "0.1", step: "any" });
    this.text = h("p", { class: "quiet" });
    this.answer = h("p", { class: "answer", role: "status" });
    this.standing = h("ul", { class: "standing" });
    const form = h("form", { class: "row", onsubmit: (event) => { event.preventDefault(); this.break_it(); } }, this.name,
      h("label", {}, "value ", this.value), h("label", {}, "for ", this.for_s, h("small", {}, " s, or until mended")), h("button", { type: "submit", "data-order": "" }, "break"));
    fill(place, h("h2", {}, "Faults on purpose"), h("p", { class: "quiet" }, "In the simulated laboratory, also in a run; each is recorded."), form, this.text, this.answer, this.standing);
  }

  async load() {
    let known;
    try { known = await get("/simulator/faults"); } catch (error) { return tell(this.answer, error.message, true); }
    if (!this.known) {
      this.known = new Map(known.faults.map((fault) => [fault.name, fault]));
      const devices = [...new Set(known.faults.map(({ name }) => name.split(".")[0]))];
      fill(this.name, devices.map((device) => h("optgroup", { label: words(device) }, known.faults.filter(({ name }) => name.startsWith(`${device}.`)).map(({ name }) => h("option", { value: name }, words(name.slice(device.length + 1)))))));
      this.describe();
    }
    const shape = JSON.stringify(known.standing);
    if (shape === this.shape) return;
    this.shape = shape;
    fill(this.standing, Object.entries(known.standing).map(([name, value]) => h("li", {}, `${name} = ${JSON.stringify(value)} `, h("button", { type: "button", "data-order": "", "aria-label": `mend ${name}`, onclick: () => this.order(`mend ${name}`, { name, mend: true }) }, "mend"))));
  }

  describe() {
    const fault = this.known.get(this.name.value);
    say(this.text, fault.text);
    this.value.value = JSON.stringify(fault.worst);
  }

  break_it() {
    const text = this.value.value.trim();
    let value;
    try { value = text === "" ? null : JSON.parse(text); } catch { value = text; }
    const for_s = this.for_s.value === "" ? null : Number(this.for_s.value);
    this.order(`break ${this.name.value}`, { name: this.name.value, value, for_s });
  }

  async order(text, body) {
    await order(this.answer, "fault", body, text);
    this.load();
  }
}
