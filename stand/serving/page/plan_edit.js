// The steps to come as rows that are changed, moved, duplicated, removed and added. The stand checks all of them after each
// change, and what is wrong stands in the row that it is about; nothing is replaced before nothing is wrong.
import { get, order, send, tell } from "./api.js";
import { duration, fill, h, words } from "./dom.js";
import { RecipeForm, collect, set_fixed } from "./recipe_form.js";

const CHECK_MS = 400;
const MOST_ROWS = 200; // with fields; of a longer plan the steps behind stay as they are

// What only a plan can give cannot be added by hand.
const is_addable = ({ properties, required }) => properties && !required?.some((name) => properties[name].readOnly);
const kind_words = (kind) => kind.replaceAll("_", " ");

export class PlanEdit {
  // steps: those of the plan from `from_index` on. axes: name and unit. over() is called when nothing is edited any more.
  constructor(place, schema, axes, from_index, steps, answer, over) {
    Object.assign(this, { place, schema, from_index, answer, over, form: new RecipeForm(schema, axes) });
    this.kept = steps.slice(MOST_ROWS).map(({ kind, parameters }) => ({ kind, parameters }));
    this.list = h("ol", { class: "edited", oninput: () => this.soon() });
    this.rows = steps.slice(0, MOST_ROWS).map((step) => this.row(step.kind, step.parameters, step.step_id, step.text));
    this.whole = h("p", { class: "answer", role: "status" });
    this.kind = h("select", { "aria-label": "Kind of step to add" }, Object.keys(schema.$defs).filter((kind) => is_addable(schema.$defs[kind])).map((kind) => h("option", { value: kind }, kind_words(kind))));
    this.kind.value = "soak";
    this.head = h("h3", { tabindex: "-1" });
    fill(place, h("div", { class: "ask", role: "group", "aria-label": "Steps to come" }, this.head, this.list,
      this.kept.length ? h("p", { class: "quiet" }, `${this.kept.length} more steps behind these stay as they are.`) : null,
      h("div", { class: "row" }, this.kind, h("button", { type: "button", onclick: () => this.add() }, "Add this step at the end")),
      this.whole,
      h("div", { class: "row" }, h("button", { type: "button", class: "main", "data-order": "", onclick: () => this.replace() }, "Use these steps"), h("button", { type: "button", onclick: () => this.close() }, "Keep the plan"))));
    this.show();
    this.head.focus();
    this.check();
  }

  row(kind, parameters, step_id = "", text = "") {
    const row = { kind, step_id, fields: this.form.fields(this.schema.$defs[kind], parameters) };
    const button = (name, act) => h("button", { type: "button", class: "small", onclick: () => act(row) }, name);
    row.number = h("span", { class: "index number quiet" });
    row.words = h("b", {}, text || kind_words(kind));
    // The set-point of frames is what the steps before make it: the stand says it, and a label is typed only where there is none.
    row.degC = this.schema.$defs[kind].properties.chamber_degC?.readOnly ? row.fields.find(({ name }) => name === "chamber_degC").row.querySelector("input") : null;
    row.fault = h("p", { class: "answer error", hidden: true });
    row.acts = [button("▲", (each) => this.move(each, -1)), button("▼", (each) => this.move(each, 1)), button("Duplicate", (each) => this.duplicate(each)), button("Remove", (each) => this.remove(each))];
    row.element = h("li", {}, row.number, h("div", { class: "what" }, row.words, h("div", { class: "values" }, row.fields.map((each) => each.row)), row.fault), h("span", { class: "acts" }, row.acts));
    return row;
  }

  // Numbers and names of the buttons, after rows have changed their places.
  show() {
    this.head.textContent = `Steps from number ${this.from_index + 1} on`;
    this.rows.forEach((row, index) => {
      const number = this.from_index + index + 1;
      row.number.textContent = String(number);
      ["Earlier", "Later", "Duplicate", "Remove"].forEach((name, at) => row.acts[at].setAttribute("aria-label", `${name}: step ${number}`));
      row.acts[0].disabled = index === 0;
      row.acts[1].disabled = index === this.rows.length - 1;
      if (this.list.children[index] !== row.element) this.list.insertBefore(row.element, this.list.children[index] ?? null);
    });
    while (this.list.children.length > this.rows.length) this.list.lastChild.remove();
  }

  changed(focus) {
    this.show();
    focus?.focus();
    this.soon();
  }

  move(row, by) {
    const at = this.rows.indexOf(row);
    this.rows.splice(at, 1);
    this.rows.splice(at + by, 0, row);
    this.changed(row.acts[by < 0 ? 0 : 1].disabled ? row.acts[by < 0 ? 1 : 0] : row.acts[by < 0 ? 0 : 1]);
  }

  duplicate(row) {
    let parameters;
    try { parameters = this.parameters(row); } catch (error) { return this.fault(row, error.message); }
    const twin = this.row(row.kind, parameters, "", row.words.textContent);
    this.rows.splice(this.rows.indexOf(row) + 1, 0, twin);
    this.changed(twin.acts[2]);
  }

  remove(row) {
    const at = this.rows.indexOf(row);
    this.rows.splice(at, 1);
    row.element.remove();
    this.changed((this.rows[at] ?? this.rows[at - 1])?.acts[3] ?? this.head);
  }

  add() {
    const like = this.rows.findLast((each) => each.kind === this.kind.value);
    let parameters = {};
    try { parameters = like ? this.parameters(like) : {}; } catch { /* its row says so */ }
    const row = this.row(this.kind.value, parameters);
    this.rows.push(row);
    this.changed();
    (row.element.querySelector("input, select, textarea") ?? row.acts[3]).focus();
  }

  label({ degC }, at_degC) {
    if (!degC || at_degC === undefined) return;
    const is_fixed = at_degC !== null;
    if (is_fixed !== degC.readOnly) this.soon(); // it was sent without its label, or with it
    set_fixed(degC, is_fixed);
    if (is_fixed) degC.value = String(at_degC);
  }

  // The steps without fields; frames are at whatever set-point the rows now give the chamber.
  behind() {
    return this.kept.map(({ kind, parameters }, index) => {
      const { chamber_degC, ...others } = parameters;
      const is_given = typeof this.kept_degC?.[index] === "number" && this.schema.$defs[kind].properties.chamber_degC?.readOnly;
      return { kind, parameters: is_given ? others : parameters };
    });
  }

  parameters({ degC, fields }) {
    const { chamber_degC, ...others } = collect(fields);
    return degC?.readOnly || chamber_degC === undefined ? others : { ...others, chamber_degC };
  }

  soon() {
    clearTimeout(this.later);
    this.later = setTimeout(() => this.check(), CHECK_MS);
  }

  fault(row, text) {
    row.fault.textContent = text;
    row.fault.hidden = !text;
    row.element.toggleAttribute("data-wrong", Boolean(text));
  }

  // The steps to be sent, or null when a field holds nothing that can be; it says so then.
  steps() {
    let is_whole = true;
    const steps = this.rows.map((row) => {
      try {
        this.fault(row, "");
        return { kind: row.kind, parameters: this.parameters(row) };
      } catch (error) {
        is_whole = false;
        this.fault(row, error.message);
        return null;
      }
    });
    return is_whole ? [...steps, ...this.behind()] : null;
  }

  // Whether the stand would take the steps as they are now. Of answers that overtake each other the last one asked for counts.
  async check() {
    clearTimeout(this.later);
    const asked = (this.asked = (this.asked ?? 0) + 1), steps = this.steps(), from_index = this.from_index;
    if (!steps) return tell(this.whole, "not all steps can be checked", true) ?? false;
    let found;
    try { found = await send("POST", "/run/plan/check", { from_index, steps }); } catch (error) { return tell(this.whole, error.message, true) ?? false; }
    if (asked !== this.asked || from_index !== this.from_index) return false;
    this.rows.forEach((row, index) => {
      row.words.textContent = found.texts[index] || kind_words(row.kind);
      this.label(row, found.set_points_degC[index]);
    });
    this.kept_degC = found.set_points_degC.slice(this.rows.length);
    for (const { index, text } of found.faults) if (this.rows[index - from_index]) this.fault(this.rows[index - from_index], text);
    const whole = found.faults.find(({ index }) => index === null || !this.rows[index - from_index]);
    const wrong = found.faults.length;
    if (whole) tell(this.whole, whole.text, true);
    else if (wrong) tell(this.whole, wrong === 1 ? "1 step is wrong; it says why" : `${wrong} steps are wrong; each says why`, true);
    else tell(this.whole, `${steps.length} steps, ${duration(found.duration_s)}`);
    return !wrong;
  }

  async replace() {
    if (!(await this.check())) return this.list.querySelector("[data-wrong] :is(input, select, textarea, button)")?.focus();
    const steps = this.steps();
    if (steps && await order(this.answer, "edit", { from_index: this.from_index, steps }, "edit the plan")) this.close();
  }

  // The plan as it is now: a step that has begun meanwhile is no longer to come.
  update(steps) {
    let dropped = 0;
    for (let now = steps[this.from_index]; now && now.standing !== "waiting" && this.rows[0]?.step_id === now.step_id; now = steps[this.from_index]) {
      this.rows.shift().element.remove();
      this.from_index += 1;
      dropped += 1;
    }
    if (dropped) this.changed();
  }

  close() {
    clearTimeout(this.later);
    fill(this.place);
    this.over();
  }
}

// What the editor needs of the stand.
export const step_schema = () => get("/plan/schema");
