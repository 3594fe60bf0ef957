// Elements, numbers and times. Text is always set as text: names of sessions and operators are anybody's.

export function h(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "value") element.value = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined));
  return element;
}

export function fill(element, ...children) {
  element.replaceChildren(...children.flat(Infinity).filter((child) => child !== null && child !== undefined));
  return element;
}

// Writes only what has changed: a screen reader reads what is written again.
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export const seconds = (ns, offset_ns = 0) => (ns + offset_ns) / 1e9;

export function clock(utc_s, with_seconds = false) {
  const options = { hour: "2-digit", minute: "2-digit", hourCycle: "h23" };
  if (with_seconds) options.second = "2-digit";
  return new Date(utc_s * 1000).toLocaleTimeString([], options);
}

export function day_clock(utc_s) {
  const date = new Date(utc_s * 1000);
  const is_today = Math.abs(utc_s - Date.now() / 1000) < 12 * 3600;
  const options = { weekday: "short", day: "numeric", month: "short" };
  if (date.getFullYear() !== new Date().getFullYear()) options.year = "numeric";
  const day = date.toLocaleDateString([], options);
  return is_today ? clock(utc_s) : `${day} ${clock(utc_s)}`;
}

// Of what may be years ago.
export function dated_clock(utc_s) {
  const day = new Date(utc_s * 1000).toLocaleDateString([], { day: "numeric", month: "short", year: "numeric" });
  return `${day}, ${clock(utc_s)}`;
}

export function duration(s) {
  const total = Math.max(0, Math.round(s));
  const hours = Math.floor(total / 3600), minutes = Math.floor((total % 3600) / 60);
  if (hours) return `${hours} h ${String(minutes).padStart(2, "0")} min`;
  if (minutes) return total < 600 && total % 60 ? `${minutes} min ${String(total % 60).padStart(2, "0")} s` : `${minutes} min`;
  return `${total} s`;
}

export function number(value, digits) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}

export const unit_of = (unit) => ({ degC: "°C", deg: "°", 1: "" })[unit] ?? unit;

// Name and unit of each stage.
export function axes_of(state) {
  const { axes, readings } = state ?? { axes: {} };
  return Object.fromEntries(Object.keys(axes).map((name) => [name, unit_of(readings[`${name}.position`]?.unit ?? "")]));
}

export function bytes(count) {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let index = 0;
  while (count >= 1000 && index < units.length - 1) { count /= 1000; index += 1; }
  return `${count.toFixed(count < 10 && index ? 1 : 0)} ${units[index]}`;
}

export const words = (name) => name.replace("setpoint", "set-point").replace(/_degC$/, " °C").replace(/_deg$/, ", °").replace(/_(mm|s|K|px|Wh)$/, ", $1").replaceAll("_", " ");

// Resume, while a trip is not reset: why not, next to the button.
export function hold_resumes(place, note, { fault }) {
  for (const button of place.querySelectorAll("button[data-resume]")) button.disabled = Boolean(fault);
  say(note, fault && place.querySelector("button[data-resume]") ? "The stand has tripped: look at it and reset it, above; then a run can be resumed." : "");
}

export const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// Asks next to the button that was pressed; never in a window of its own, which could lie over STOP.
export function ask(place, question, yes, act) {
  place.querySelector(".ask")?.remove();
  const box = h("div", { class: "ask", role: "group", "aria-label": question });
  const away = () => box.remove();
  const button = h("button", { class: "danger", type: "button", onclick: () => { away(); act(); } }, yes);
  box.append(h("p", {}, question), h("div", { class: "row" }, button, h("button", { type: "button", onclick: away }, "No")));
  place.append(box);
  button.focus();
}
