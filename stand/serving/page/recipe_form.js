// A form made from the recipe's JSON Schema. A field that is left at its default is not sent, so that the default of
// the stand's version is what counts.
import { fill, h, words } from "./dom.js";

export class RecipeForm {
  constructor(schema, axes) {
    this.schema = schema;
    this.axes = axes;
    this.element = h("div", { class: "stack" });
    // What is wrong in a folded part is shown.
    this.element.addEventListener("invalid", ({ target }) => { for (let part = target.closest("details"); part; part = part.parentElement.closest("details")) part.open = true; }, true);
  }

  resolve(schema) {
    while (schema.$ref) schema = this.schema.$defs[schema.$ref.split("/").pop()];
    let choices = schema.anyOf?.filter((each) => each.type !== "null");
    const objects = choices?.filter((each) => each.$ref);
    if (choices?.length === 2 && objects.length === 1) choices = objects; // the other one is a short way to write it
    return choices?.length === 1 ? { ...this.resolve(choices[0]), default: schema.default } : schema;
  }

  // The kinds of experiment that have fields of their own.
  kinds() {
    const { properties } = this.resolve(this.schema.properties.experiments.items);
    return Object.keys(properties).filter((kind) => { const each = this.resolve(properties[kind]); return each.properties || each.type === "array"; });
  }

  load(recipe) {
    this.parts = [];
    this.steps = recipe.steps?.length ? this.rows_field("steps, one after another", this.schema.properties.steps, recipe.steps, true) : null;
    this.name = name_field(recipe.name ?? "");
    this.about = text_field("description", recipe.description ?? "", { maxlength: 1000 });
    this.places = h("div", { class: "stack" });
    this.more = h("select", { "aria-label": "Kind of experiment" }, this.kinds().map((kind) => h("option", { value: kind }, words(kind))));
    fill(this.element, h("fieldset", {}, h("legend", {}, "Recipe"), this.name.row, this.about.row), this.places, this.steps?.row,
      this.steps ? null : h("div", { class: "row" }, this.more, h("button", { type: "button", onclick: () => this.add(this.more.value, {}) }, "Add this experiment")));
    for (const experiment of recipe.experiments ?? []) {
      const [[kind, values]] = Object.entries(experiment);
      this.add(kind, values);
    }
  }

  add(kind, values) {
    const items = this.resolve(this.schema.properties.experiments.items);
    const schema = items.properties[kind] ? this.resolve(items.properties[kind]) : {};
    const fields = schema.properties ? this.fields(schema, values) : [schema.type === "array" ? this.rows_field(kind, schema, Array.isArray(values) ? values : [], true) : json_field("", values, "As JSON")];
    const box = h("fieldset", {}, h("legend", {}, words(kind)));
    const part = { kind, fields, is_whole: !schema.properties };
    // What is at its usual value is one click away: the rest is what this recipe is about.
    const [asked, usual] = schema.properties ? split_usual(schema, values, fields) : [fields, []];
    const more = usual.length ? h("details", {}, h("summary", {}, usual.length === 1 ? "1 more, at its usual value" : `${usual.length} more, at their usual values`), usual.map((field) => field.row)) : null;
    box.append(...asked.map((field) => field.row), ...(more ? [more] : []), h("button", { type: "button", class: "small", onclick: () => { this.parts.splice(this.parts.indexOf(part), 1); box.remove(); } }, `Remove this ${words(kind)}`));
    this.parts.push(part);
    this.places.append(box);
  }

  fields(schema, values) {
    return Object.entries(schema.properties).map(([name, each]) => this.field(name, { default: each.default, ...this.resolve(each) }, values[name], schema.required?.includes(name)));
  }

  // What follows from the plan is shown, and nobody types it.
  field(name, schema, value, required) {
    const made = this.field_of(name, schema, value, required);
    if (schema.readOnly) for (const input of made.row.querySelectorAll("input, select, textarea")) set_fixed(input, true);
    return made;
  }

  field_of(name, schema, value, required) {
    const given = value ?? schema.default;
    if (schema.enum) return choice_field(name, schema.enum, given, schema.description);
    if (schema.type === "number" || schema.type === "integer") return number_field(name, schema, given, required);
    if (schema.type === "boolean") return flag_field(name, Boolean(given), schema.description);
    if (schema.type === "string") return text_field(name, given ?? "", { pattern: schema.pattern, maxlength: schema.maxLength, required }, schema.description);
    if (schema.type === "array" && this.resolve(schema.items ?? {}).type === "number") return list_field(name, this.resolve(schema.items), given ?? [], required, schema.description);
    if (schema.type === "object" && schema.additionalProperties?.type === "number") return this.position_field(name, given ?? {});
    if (schema.properties) return this.object_field(name, schema, given, required);
    if (schema.type === "array" && this.resolve(schema.items ?? {}).properties) return this.rows_field(name, schema, given ?? [], required);
    if (schema.type === "array" ? schema.items?.type === "string" : is_texts(schema)) return texts_field(name, given ?? [], required);
    const words_of = (schema.anyOf ?? []).filter((each) => each.const).map((each) => JSON.stringify(each.const));
    return json_field(name, given ?? null, schema.description ?? `${words_of.map((each) => `${each}, or `).join("")}more as JSON; empty for none`);
  }

  // An object within another: its fields are there when it is asked for.
  object_field(name, schema, value, required) {
    const given = whole(schema, long(value)), inner = this.fields(schema, given ?? {});
    const is_asked = h("input", { type: "checkbox", "aria-label": words(name) });
    is_asked.checked = required || Boolean(given);
    const box = h("fieldset", { hidden: !is_asked.checked }, h("legend", {}, words(name)), inner.map((each) => each.row));
    is_asked.addEventListener("change", () => { box.hidden = !is_asked.checked; });
    const place = h("div", { class: "grow" }, required ? null : is_asked, inner.length ? box : null);
    return nested(field(name, place, "", () => (is_asked.checked ? collect(inner) : undefined)));
  }

  // Objects one after another; of one with a choice of keys, such as a step, one key is chosen.
  rows_field(name, schema, values, required) {
    const items = this.resolve(schema.items), rows = [], kinds = Object.keys(items.properties);
    const is_choice = kinds.length > 1 && !items.required && kinds.every((kind) => items.properties[kind].default === null);
    const list = h("div", { class: "stack" });
    const choice = h("select", { "aria-label": `Kind of ${words(name)}` }, kinds.map((kind) => h("option", { value: kind }, words(kind))));
    const add = (value) => {
      const kind = is_choice ? Object.keys(value)[0] : null;
      const chosen = is_choice ? this.resolve(items.properties[kind]) : items;
      const inner = chosen.properties ? this.fields(chosen, whole(chosen, is_choice ? value[kind] : value) ?? {}) : [this.field(kind, chosen, value[kind], true)];
      const found = () => (chosen.properties ? collect(inner) : inner[0].value() ?? value[kind] ?? {});
      const row = { value: () => (is_choice ? { [kind]: found() } : found()) };
      const box = h("fieldset", {}, h("legend", {}, words(kind ?? name)), inner.map((each) => each.row),
        h("button", { type: "button", class: "small", "aria-label": `Remove ${words(kind ?? name)} ${rows.length + 1}`, onclick: () => { rows.splice(rows.indexOf(row), 1); box.remove(); } }, "Remove"));
      rows.push(row);
      list.append(box);
    };
    for (const value of values) add(long(value));
    const more = h("div", { class: "row" }, is_choice ? choice : null, h("button", { type: "button", class: "small", onclick: () => add(is_choice ? { [choice.value]: undefined } : {}) }, `Add to ${words(name)}`));
    return nested(field(name, h("div", { class: "stack grow" }, list, more), "", () => (rows.length || required ? rows.map((row) => row.value()) : undefined)));
  }

  position_field(name, values) {
    const names = [...new Set([...Object.keys(this.axes), ...Object.keys(values)])];
    const inputs = names.map((axis) => h("input", { type: "number", step: "any", value: values[axis] ?? "", "aria-label": `${words(name)}: ${axis}` }));
    return field(name, h("span", { class: "row" }, names.map((axis, index) => h("span", {}, `${axis} `, inputs[index], ` ${this.axes[axis] ?? ""}`))), "", () => {
      const found = Object.fromEntries(names.map((axis, index) => [axis, inputs[index].value]).filter(([, text]) => text !== "").map(([axis, text]) => [axis, Number(text)]));
      return Object.keys(found).length ? found : undefined;
    });
  }

  // The recipe that the form holds; throws an Error with a sentence when a field holds nothing that can be sent.
  recipe() {
    const experiments = this.parts.map(({ kind, fields, is_whole }) => ({ [kind]: is_whole ? fields[0].value() : collect(fields) }));
    const recipe = { name: this.name.value() };
    if (this.about.value()) recipe.description = this.about.value();
    if (experiments.length) recipe.experiments = experiments;
    if (this.steps) recipe.steps = this.steps.value();
    return recipe;
  }
}

// The fields that the recipe gives, or has to, and those that are as usual.
function split_usual(schema, values, fields) {
  const is_asked = ({ name }) => name in values || schema.required?.includes(name);
  return [fields.filter(is_asked), fields.filter((each) => !is_asked(each))];
}

// What holds other fields has its name above them, so that parts within parts do not become narrower and narrower.
function nested(made) {
  made.row.classList.add("nested");
  return made;
}

// What may be written as a word is an object with that key: `open_flap`, `settled`.
const long = (value) => (typeof value === "string" ? { [value]: {} } : value);

// What may be written as a number is an object with its first required key: `soak: 2700`.
const whole = (schema, value) => (typeof value === "number" ? { [schema.required[0]]: value } : value);

const is_texts = (schema) => schema.anyOf?.some((each) => each.type === "array" && each.items?.type === "string");

export function set_fixed(input, is_fixed) {
  if (input.matches("select, [type='checkbox']")) input.disabled = is_fixed;
  else input.readOnly = is_fixed;
}

export function collect(fields) {
  return Object.fromEntries(fields.map((each) => [each.name, each.value()]).filter(([, value]) => value !== undefined));
}

let count = 0;

function field(name, input, help, value) {
  const id = `field-${(count += 1)}`;
  const control = input.matches("input, select, textarea") ? input : null;
  control?.setAttribute("id", id);
  if (control && help) control.setAttribute("aria-describedby", `${id}-help`);
  const label = control ? h("label", { for: id }, words(name)) : h("span", {}, words(name));
  return { name, value, row: h("div", { class: "field" }, label, input, help ? h("small", { id: `${id}-help` }, help) : null) };
}

// Waits are typed in minutes where people think in minutes.
const in_minutes = (name, schema, given) => name.endsWith("_s") && !name.startsWith("interval") && (schema.maximum ?? Infinity) >= 3600 && (schema.default ?? given ?? 3600) >= 60;

function number_field(name, schema, given, required) {
  const scale = in_minutes(name, schema, given) ? 60 : 1;
  const shown = (value) => (value === undefined || value === null ? undefined : Math.round((value / scale) * 1e6) / 1e6);
  const least = shown(schema.minimum ?? schema.exclusiveMinimum), most = shown(schema.maximum ?? schema.exclusiveMaximum);
  const input = h("input", { type: "number", step: schema.type === "integer" ? 1 : "any", min: least, max: most, required, value: shown(given) ?? "" });
  const before = input.value;
  const bounds = least !== undefined && most !== undefined ? `${least} to ${most}` : least !== undefined ? `${least} or more` : most !== undefined ? `${most} or less` : "";
  const usual = schema.default !== undefined && schema.default !== null ? `usually ${shown(schema.default)}` : "";
  const help = help_of(schema.description, [bounds, usual].filter(Boolean).join("; "));
  const typed = () => (input.value === before && given !== null ? given : scale === 1 ? Number(input.value) : Math.round(Number(input.value) * scale * 1e6) / 1e6);
  const made = field(name, input, help, () => (input.value === "" || typed() === schema.default ? undefined : typed()));
  if (scale === 60) made.row.querySelector("label").textContent = words(name).replace(/, s$/, ", min");
  return made;
}

const help_of = (description, more) => [description, more].filter(Boolean).join(" ");

function text_field(name, given, attributes, help = "") {
  const input = h("input", { type: "text", value: given, ...attributes });
  return field(name, input, help, () => input.value || undefined);
}

// A name is made valid where it can be, and refused only when nothing of it is left.
function name_field(given) {
  const made = text_field("name", given, { maxlength: 100, required: true }, "Letters, digits and hyphens.");
  const input = made.row.querySelector("input");
  input.addEventListener("change", () => { input.value = valid_name(input.value); });
  return { ...made, value: () => valid_name(input.value) || undefined };
}

export const valid_name = (text) => text.normalize("NFKD").replace(/\p{M}/gu, "").toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-+|-+$/g, "").slice(0, 100);

function flag_field(name, given, help = "") {
  const input = h("input", { type: "checkbox" });
  input.checked = given;
  return field(name, input, help, () => input.checked);
}

function choice_field(name, choices, given, help = "") {
  const input = h("select", {}, choices.map((each) => h("option", { value: each }, words(each))));
  input.value = given;
  return field(name, input, help, () => input.value);
}

function list_field(name, items, given, required, description) {
  const input = h("input", { type: "text", value: given.join(", "), required, inputmode: "text", size: 40 });
  const bounds = items.minimum !== undefined ? `, each ${items.minimum} to ${items.maximum}` : "";
  return field(name, input, help_of(description, `numbers with commas between them${bounds}`), () => {
    const texts = input.value.split(/[\s,;]+/).filter(Boolean), numbers = texts.map(Number);
    const wrong = texts.find((_, index) => Number.isNaN(numbers[index]));
    if (wrong !== undefined) throw new Error(`${words(name)}: ${wrong} is not a number`);
    return numbers.length || required ? numbers : undefined;
  });
}

function texts_field(name, given, required) {
  const input = h("input", { type: "text", value: [given].flat().join(", "), required });
  return field(name, input, "names with commas between them", () => {
    const texts = input.value.split(/[,;]/).map((text) => text.trim()).filter(Boolean);
    return texts.length ? texts : undefined;
  });
}

function json_field(name, given, help) {
  const input = h("textarea", { rows: given ? Math.min(14, JSON.stringify(given, null, 1).split("\n").length + 1) : 1, spellcheck: "false", "aria-label": words(name) || "as JSON" });
  input.value = given === null || given === undefined || (Array.isArray(given) && !given.length) ? "" : JSON.stringify(given, null, 1);
  return field(name, input, help, () => {
    if (!input.value.trim() || input.value.trim() === "null") return undefined;
    try { return JSON.parse(input.value); } catch (error) { throw new Error(`${words(name)}: no JSON (${error.message})`); }
  });
}
