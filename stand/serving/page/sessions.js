// Recorded sessions, their reports, and two sessions one over the other.
import { called, get, order, tell } from "./api.js";
import { look_of } from "./channels.js";
import { swatch } from "./now.js";
import { bytes, css, dated_clock, duration, fill, h, hold_resumes, seconds } from "./dom.js";
import uPlot from "./uPlot.js";

const MOST_ROWS = 200;
const RESUMABLE = ["interrupted", "stopped", "tripped", "failed"]; // recording/reading/run_status.py
// A dash shows which session: here colours alone distinguish air from camera, and must be far apart.
const COMPARED = [["thermometers.air", "--c-granite"], ["camera.temperature", "--c-camera"]];

export class Sessions {
  constructor(place, app) {
    this.app = app;
    this.chosen = [];
    this.plots = [];
    this.answer = h("p", { class: "answer", role: "status" });
    this.resumes = h("p", { class: "level-warning", role: "status" });
    this.rows = h("tbody");
    this.search = h("input", { type: "search", placeholder: "search", "aria-label": "Search sessions by name, recipe, operator or tag", oninput: () => this.show() });
    this.compare_button = h("button", { type: "button", disabled: true, onclick: () => this.compare() }, "Show");
    this.comparison = h("section", { class: "panel", hidden: true });
    const head = ["", "session", "recipe", "began", "took", "frames", "size", "run", "files", ""].map((name) => h("th", { scope: "col", class: ["took", "frames", "size"].includes(name) ? "number" : undefined }, name || h("span", { class: "unseen" }, "actions")));
    fill(place, h("div", { class: "stack" },
      this.comparison,
      h("section", { class: "panel" }, h("div", { class: "head" }, h("h2", {}, "Sessions"), this.search, this.compare_button), this.answer, this.resumes,
        this.table = h("div", { class: "scroll", hidden: true }, h("table", { class: "sessions" }, h("thead", {}, h("tr", {}, head)), this.rows)))));
    this.load();
  }

  async load() {
    if (!this.sessions) tell(this.answer, "reading the list of sessions …");
    try {
      this.sessions = (await get("/sessions")).sort((one, other) => (begun_ns(other) ?? 0) - (begun_ns(one) ?? 0));
      if (!this.closed) this.show();
    } catch (error) { tell(this.answer, error.message, true); }
  }

  show() {
    const text = this.search.value.toLowerCase();
    const matches = (each) => [each.name, each.recipe, each.operator, ...(each.tags ?? [])].join(" ").toLowerCase().includes(text);
    const found = (this.sessions ?? []).filter(matches);
    fill(this.rows, found.slice(0, MOST_ROWS).map((each) => this.row(each)));
    this.table.hidden = !found.length;
    const none = this.sessions?.length ? "no session matches the search" : "No session is recorded here yet. Each run makes one, and so does each day.";
    tell(this.answer, found.length ? (found.length > MOST_ROWS ? `the latest ${MOST_ROWS} of ${found.length}; the search finds the others` : "") : none);
    this.choose();
    if (this.app.state) this.update(this.app.state);
  }

  row(each) {
    const box = h("input", { type: "checkbox", "aria-label": `Choose ${each.name}`, onchange: () => this.pick(each.name, box.checked) });
    box.checked = this.chosen.includes(each.name);
    const took = each.begin_ns && each.end_ns ? duration((each.end_ns - each.begin_ns) / 1e9) : "–";
    const path = encodeURIComponent(each.name), actions = h("span", { class: "row" });
    if (each.has_report) actions.append(h("a", { href: `/api/v1/sessions/${path}/report.html`, target: "_blank", rel: "noopener" }, "report"));
    if (RESUMABLE.includes(each.run)) actions.append(called("resume", h("button", { type: "button", class: "small", "data-order": "", "data-resume": "", onclick: () => order(this.answer, "resume", { session: each.name }, `resume ${each.name}`) }), undefined, (title) => `${title} ${each.name}`));
    actions.append(called("note", h("button", { type: "button", class: "small", "data-order": "", onclick: () => this.note(each, actions) }), undefined, () => `Add a note to ${each.name}`));
    const troubles = [...(each.troubles ?? []), ...(each.missing ?? [])];
    return h("tr", {}, h("td", {}, box),
      h("td", {}, each.name, each.simulated ? " " : "", each.simulated ? h("span", { class: "tag" }, "simulated") : null, ...(each.tags ?? []).flatMap((tag) => [" ", h("span", { class: "tag" }, tag)]),
        (each.notes ?? []).map((note) => h("small", { class: "note-text" }, `${note.by ? `${note.by}: ` : ""}${note.text ?? note}`))),
      h("td", {}, each.recipe), h("td", {}, begun_ns(each) ? dated_clock(seconds(begun_ns(each))) : "–"), h("td", { class: "number" }, took),
      h("td", { class: "number" }, String(each.frames)), h("td", { class: "number" }, bytes(each.bytes ?? 0)), h("td", {}, each.run),
      h("td", { title: troubles.join("\n"), class: troubles.length ? "level-error" : "" }, each.files, each.copies ? h("small", { class: "note-text" }, each.copies.length ? "archived" : "not archived") : null), h("td", {}, actions));
  }

  note(each, place) {
    if (place.querySelector("form")) return;
    const input = h("input", { type: "text", maxlength: 4000, "aria-label": `Note on ${each.name}`, size: 30 });
    const form = h("form", { class: "row", onsubmit: async (event) => {
      event.preventDefault();
      if (await order(this.answer, "note", { session: each.name, text: input.value })) { form.remove(); this.load(); }
    } }, input, h("button", { type: "submit", class: "small", "data-order": "" }, "Keep"));
    place.append(form);
    input.focus();
  }

  pick(name, is_chosen) {
    this.chosen = this.chosen.filter((each) => each !== name);
    if (is_chosen) this.chosen.push(name);
    if (this.chosen.length > 2) { this.chosen.shift(); this.show(); }
    this.choose();
  }

  choose() {
    this.compare_button.disabled = !this.chosen.length;
    this.compare_button.textContent = this.chosen.length === 2 ? "Compare these two sessions" : "Show this session";
  }

  async compare() {
    const names = [...this.chosen];
    tell(this.answer, `reading ${names.join(" and ")} …`);
    try {
      const histories = await Promise.all(names.map((name) => get(`/sessions/${encodeURIComponent(name)}/history?points=1000`)));
      if (this.closed) return;
      tell(this.answer, "");
      this.draw(names, histories);
    } catch (error) { tell(this.answer, error.message, true); return; }
    for (const [index, name] of names.entries()) this.find_drift(name, index, names);
  }

  // Markers of a whole session take longer than its curves: they are shown when they are there.
  async find_drift(name, index, names) {
    const place = this.drift_answers[index];
    try {
      tell(place, `finding the markers of ${name} …`);
      const drift = await get(`/sessions/${encodeURIComponent(name)}/drift`);
      if (this.closed || this.shown_names !== names) return;
      tell(place, drift.points.length ? "" : `${name}: no drift (${drift.trouble || "no frames for it"})`);
      this.drift[index] = drift;
      this.draw_drift();
    } catch (error) { tell(place, `${name}: ${error.message}`, true); }
  }

  draw(names, histories) {
    this.clear();
    this.shown_names = names;
    this.histories = histories;
    this.drift = names.map(() => ({ points: [] }));
    this.comparison.hidden = false;
    const place = h("div", { class: "curve", role: "img", "aria-label": `Temperatures of ${names.join(" and ")} over the hours since their beginnings` });
    const drift = h("div", { class: "curve", role: "img", "aria-label": `Mean drift of ${names.join(" and ")}` });
    this.drift_answers = names.map(() => h("p", { class: "answer quiet", role: "status" }));
    const key = names.map((name, index) => h("p", {}, `${index ? "dashed" : "solid"}: `, h("b", {}, name)));
    fill(this.comparison, h("div", { class: "head" }, h("h2", {}, names.length > 1 ? "Two sessions, hours since their beginnings" : "One session, hours since its beginning"),
      h("button", { type: "button", class: "small", onclick: () => { this.clear(); this.comparison.hidden = true; } }, "Close")), key,
      h("p", { class: "curve-name row" }, "°C: ", COMPARED.map(([channel, colour]) => h("span", { class: "row" }, swatch({ colour, dash: [], width: 2 }), look_of(channel).name))), place, h("p", { class: "curve-name" }, "Mean drift, px"), drift, this.drift_answers);
    this.drift_place = drift;
    const series = histories.flatMap((history, index) => COMPARED.filter(([channel]) => history.low[channel]).map(([channel, colour]) => ({
      name: `${look_of(channel).name}, ${names[index]}`, colour, dash: index ? [6, 4] : [],
      x: hours(history), y: history.high[channel] ?? history.low[channel] })));
    this.plots.push(new Lines(place, 280, series));
    this.draw_drift();
    this.comparison.scrollIntoView({ block: "start" });
  }

  draw_drift() {
    this.drift_plot?.destroy();
    const series = this.drift.map((drift, index) => ({
      name: this.shown_names[index], colour: index ? "--c-worst" : "--c-mean", dash: index ? [6, 4] : [],
      x: drift.points.map((point) => (point.time_ns - this.histories[index].from_ns) / 3600e9), y: drift.points.map((point) => point.mean_px) }));
    this.drift_plot = series.some((each) => each.x.length) ? new Lines(this.drift_place, 200, series) : null;
  }

  clear() {
    for (const plot of this.plots) plot.destroy();
    this.plots = [];
    this.drift_plot?.destroy();
    this.drift_plot = null;
  }

  update(state) { hold_resumes(this.rows, this.resumes, state); }
  soon() { this.load(); }
  event(event) { if (["run.end", "reported", "not_reported"].includes(event.kind)) this.load(); }
  close() { this.closed = true; this.clear(); }
}

// Of one whose first segment is still written, by its name.
function begun_ns(each) {
  if (each.begin_ns) return each.begin_ns;
  const at = /^(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)(\d\d)Z/.exec(each.name);
  return at && Date.parse(`${at[1]}-${at[2]}-${at[3]}T${at[4]}:${at[5]}:${at[6]}Z`) * 1e6;
}

const hours = (history) => Array.from({ length: history.points }, (_, n) => ((n + 0.5) * history.width_ns) / 3600e9);

// Lines that do not share their x.
class Lines {
  constructor(place, height, series) {
    this.place = place;
    this.height = height;
    const axis = { stroke: css("--quiet"), grid: { stroke: css("--faint"), width: 1 }, ticks: { stroke: css("--line"), width: 1, size: 4 }, font: "12px system-ui, sans-serif" };
    const data = series.length > 1 ? uPlot.join(series.map((each) => [each.x, each.y])) : [series[0]?.x ?? [], series[0]?.y ?? []];
    this.plot = new uPlot({
      width: Math.max(200, place.clientWidth), height, legend: { show: false }, scales: { x: { time: false } },
      axes: [{ ...axis, size: 28, space: 80, values: (_, ticks) => ticks.map((tick) => `${tick} h`) }, { ...axis, size: 52 }],
      series: [{}, ...series.map((each) => ({ label: each.name, stroke: css(each.colour), dash: each.dash, width: 1.8, spanGaps: true, points: { show: false } }))],
    }, data, place);
    this.plot.root.setAttribute("aria-hidden", "true");
    this.resizing = new ResizeObserver(() => { const width = Math.floor(place.clientWidth); if (width > 0 && Math.abs(width - this.plot.width) > 1) this.plot.setSize({ width, height }); });
    this.resizing.observe(place);
  }

  destroy() { this.resizing.disconnect(); this.plot.destroy(); }
}
