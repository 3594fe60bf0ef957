// The queue of runs, and the form that adds one.
import { called, get, order, tell } from "./api.js";
import { Design } from "./design.js";
import { ask, axes_of, day_clock, duration, fill, h, hold_resumes, seconds } from "./dom.js";
import { RecipeForm } from "./recipe_form.js";

const ENDED = ["done", "failed", "stopped"];
const RESUMABLE = ["interrupted", "stopped", "failed"]; // a run that has tripped has failed here
const MOST_ENDED = 10;

export class Queue {
  constructor(place, app) {
    this.app = app;
    this.place = place;
    this.resumes = h("p", { class: "level-warning", role: "status" });
    this.answer = h("p", { class: "answer", role: "status" });
    this.list = h("ol", { class: "queue", "aria-label": "Runs to be done, the next one first" });
    this.ended = h("ol", { class: "queue" });
    this.form_answer = h("p", { class: "answer", role: "status" });
    this.choice = h("select", { id: "recipe", onchange: () => this.choose() });
    this.attended = h("input", { type: "checkbox", id: "attended" });
    this.note = h("input", { type: "text", id: "note", maxlength: 4000, size: 40 });
    this.tags = h("input", { type: "text", id: "tags", maxlength: 300, size: 24, placeholder: "lens-a, after-service" });
    this.parameters = h("fieldset", { class: "bare", disabled: true, oninput: () => this.changed(), onclick: (event) => event.target.closest("button") && this.changed() });
    this.details = h("details", {}, h("summary", {}, "Look at and change its parameters"), this.parameters);
    this.yaml = h("textarea", { rows: 16, cols: 80, spellcheck: "false", "aria-label": "The recipe as YAML", oninput: () => { this.is_typed = true; this.look(); } });
    this.as_yaml = h("details", { ontoggle: () => this.look(0) }, h("summary", {}, "As YAML"), h("p", { class: "quiet" }, "What is changed here changes the fields above when it is a recipe."), this.yaml);
    this.start = h("button", { type: "submit", class: "main", "data-order": "" }, "Add to the queue");
    this.rehearse = called("rehearse", h("button", { type: "button", "data-order": "", title: "In virtual time, in a simulated laboratory: nothing of this stand moves", onclick: () => this.give("rehearse") }));
    this.save = called("save_recipe", h("button", { type: "button", "data-order": "", onclick: () => this.give("save_recipe") }));
    this.remove = called("remove_recipe", h("button", { type: "button", "data-order": "", hidden: true, onclick: () => this.give("remove_recipe") }));
    this.design = new Design(app, (from, to) => this.move_level(from, to), (preview) => this.looked(preview));
    this.asked = 0;
    const form = h("form", { class: "fields", onsubmit: (event) => { event.preventDefault(); this.submit(); } },
      h("div", { class: "field" }, h("label", { for: "recipe" }, "recipe"), this.choice),
      this.about = h("p", { class: "quiet" }),
      this.design.element,
      this.details, this.as_yaml,
      h("div", { class: "field" }, h("label", { for: "attended" }, "somebody attends"), this.attended, h("small", {}, "the run then waits at each prompt until it is answered")),
      h("div", { class: "field" }, h("label", { for: "tags" }, "tags"), this.tags),
      h("div", { class: "field" }, h("label", { for: "note" }, "note"), this.note),
      h("div", { class: "row" }, this.start, this.rehearse, this.save, this.remove), this.form_answer);
    fill(place, h("div", { class: "grid" },
      h("div", { class: "stack" },
        h("section", { class: "panel" }, h("h2", {}, "Start a run"), form)),
      h("div", { class: "stack" },
        h("section", { class: "panel" }, h("h2", {}, "To be done"), this.list, this.answer, this.resumes),
        h("section", { class: "panel" }, h("h2", {}, "Ended"), this.ended))));
    this.load();
  }

  async load() {
    try {
      const [recipes, schema] = await Promise.all([get("/recipes"), get("/recipes/schema")]);
      if (this.closed) return;
      this.form = new RecipeForm(schema, axes_of(this.app.state));
      this.parameters.append(this.form.element);
      this.list_recipes(recipes);
      this.choice.value = recipes.some(({ name }) => name === "overnight") ? "overnight" : recipes[0]?.name;
      await this.choose();
    } catch (error) { tell(this.form_answer, error.message, true); }
  }

  list_recipes(recipes) {
    const chosen = this.choice.value, group = (name, own) => h("optgroup", { label: name }, recipes.filter((each) => each.own === own).map(({ name: each }) => h("option", { value: each }, each)));
    this.own = new Set(recipes.filter(({ own }) => own).map(({ name }) => name));
    fill(this.choice, this.own.size ? group("yours", true) : null, group("installed", false));
    if (recipes.some(({ name }) => name === chosen)) this.choice.value = chosen;
  }

  async choose() {
    const wanted = this.choice.value, asked = ++this.asked;
    this.parameters.disabled = this.start.disabled = true;  // what is changed now would be lost when the answer comes
    try {
      const recipe = await get(`/recipes/${encodeURIComponent(wanted)}`);
      if (this.asked !== asked) return;  // it was chosen from again, and this answer may come last
      this.installed = wanted;
      this.about.textContent = recipe.description ?? "";
      this.remove.hidden = !this.own.has(wanted);
      this.form.load(recipe);
      this.unchanged = JSON.stringify(this.form.recipe());
      this.parameters.disabled = this.start.disabled = this.is_typed = false;
      this.design.soon(() => this.request(), 0);
    } catch (error) { if (this.asked === asked) tell(this.form_answer, error.message, true); }
  }

  // What is designed here: an installed recipe as it is, the text that was typed, or what the fields hold.
  request() {
    if (this.is_typed) return { recipe_text: this.yaml.value };
    const recipe = JSON.stringify(this.form.recipe());
    return recipe === this.unchanged ? { recipe: this.installed } : { recipe_text: recipe };
  }

  changed() {
    this.is_typed = false;
    this.look();
  }

  look(wait_ms) { if (this.form?.parts) this.design.soon(() => this.request(), wait_ms); }

  // The fields and the text are two views of one recipe; the one that is typed in stays as it is.
  looked(preview) {
    this.start.disabled = this.rehearse.disabled = this.save.disabled = !preview;
    if (!preview) return;
    if (this.is_typed) this.form.load(preview.recipe);
    else if (document.activeElement !== this.yaml) this.yaml.value = preview.recipe_text;
  }

  // Every set-point of that temperature, wherever the recipe has it.
  move_level(from, to) {
    const moved = (key, value) => (Array.isArray(value) ? value.map((each) => moved(key, each)) : value && typeof value === "object" ? Object.fromEntries(Object.entries(value).map(([inner, each]) => [inner, moved(inner, each)])) : key.endsWith("_degC") && value === from ? to : value);
    this.is_typed = false;
    this.form.load(moved("", this.design.preview.recipe));
    this.look(0);
  }

  // Rehearse, save, or remove what is designed.
  async give(verb) {
    if (verb === "save_recipe") await this.design.ask(() => this.request()); // as it is now
    const { preview } = this.design;
    if (!preview && verb === "save_recipe") return;
    const name = verb === "remove_recipe" ? this.installed : preview?.recipe.name;
    const given = { rehearse: () => this.request(), save_recipe: () => ({ recipe: name, recipe_text: preview.recipe_text }), remove_recipe: () => ({ recipe: name }) }[verb]();
    if (!await order(this.form_answer, verb, given) || verb === "rehearse") return;
    const recipes = await get("/recipes").catch(() => null);
    if (!recipes) return;
    this.list_recipes(recipes);
    if (verb === "save_recipe") this.choice.value = name;
    this.choose();
  }

  async submit() {
    let wanted;
    try { wanted = this.request(); } catch (error) { return tell(this.form_answer, error.message, true); }
    wanted.attended = this.attended.checked;
    const tags = this.tags.value.split(/[\s,;]+/).filter(Boolean);
    if (tags.length) wanted.tags = tags;
    if (this.note.value) wanted.note = this.note.value;
    const body = JSON.stringify(wanted);
    // The same key until something is changed or the stand has answered: pressed twice, it is one run.
    if (body !== this.sent) { this.sent = body; this.key = `page-${Date.now()}-${Math.random().toString(36).slice(2)}`; }
    this.start.disabled = true;
    const run = await order(this.form_answer, "submit", { ...wanted, key: this.key }, "checking wires, disk and limits");
    this.start.disabled = false;
    if (run) {
      this.sent = null;
      this.note.value = "";
      this.look(0);
      tell(this.form_answer, `run ${run.id} (${run.recipe}) is queued${run.expected_s ? `; it will take ${duration(run.expected_s)}` : ""}`);
    }
  }

  update(state) {
    this.show(state);
    hold_resumes(this.place, this.resumes, state);
  }

  show(state) {
    const runs = state.queue, key = JSON.stringify(runs);
    if (key === this.shown || this.dragged) return;
    if (this.list.querySelector(".ask")) return;
    this.shown = key;
    const open = runs.filter((run) => !ENDED.includes(run.state));
    const movable = open.filter((run) => run.state !== "running");
    fill(this.list, open.length ? open.map((run) => this.row(run, movable)) : h("li", {}, h("span"), h("span", { class: "quiet" }, "nothing is queued")));
    const ended = runs.filter((run) => ENDED.includes(run.state)).slice(-MOST_ENDED).reverse();
    fill(this.ended, ended.length ? ended.map((run) => this.row(run, [])) : h("li", {}, h("span"), h("span", { class: "quiet" }, "none yet")));
  }

  row(run, movable) {
    const at = movable.indexOf(run), offset_ns = this.app.state.utc_offset_ns;
    const acts = h("span", { class: "row" });
    const button = (name, act, sign, label, disabled = false) => acts.append(called(name, h("button", { type: "button", class: "small", "data-order": "", "data-resume": name === "resume", disabled, onclick: act }), (title) => sign ?? title, (title) => `${label ?? title}: run ${run.id}`));
    const row = h("li", { draggable: at >= 0 ? "true" : undefined }, h("span", { class: "number quiet" }, String(run.id)),
      h("span", {}, h("b", {}, run.recipe), ` ${run.state}`, time_of(run),
        h("br"), h("small", {}, [run.reason, run.added_by && `by ${run.added_by}`, `added ${day_clock(seconds(run.added_ns, offset_ns))}`, run.session].filter(Boolean).join(" · "))), acts);
    if (at >= 0) {
      button("move", () => this.move(run, at), "▲", "Earlier", at === 0);
      button("move", () => this.move(run, at + 2), "▼", "Later", at === movable.length - 1);
      button("cancel", () => ask(row, `Take run ${run.id} (${run.recipe}) out of the queue?`, "Remove it", () => order(this.answer, "cancel", { run: run.id }, "remove")));
      this.drag(row, run, at);
    }
    if (RESUMABLE.includes(run.state) && run.session) button("resume", () => order(this.answer, "resume", { session: run.session }));
    return row;
  }

  drag(row, run, at) {
    row.addEventListener("dragstart", (event) => { this.dragged = run; event.dataTransfer.effectAllowed = "move"; event.dataTransfer.setData("text/plain", String(run.id)); });
    row.addEventListener("dragend", () => { this.dragged = null; });
    row.addEventListener("dragover", (event) => { if (this.dragged) { event.preventDefault(); row.classList.add("over"); } });
    row.addEventListener("dragleave", () => row.classList.remove("over"));
    row.addEventListener("drop", (event) => {
      event.preventDefault();
      row.classList.remove("over");
      const moved = this.dragged;
      this.dragged = null;
      if (moved && moved.id !== run.id) this.move(moved, at + 1);
    });
  }

  move(run, to) { order(this.answer, "move", { run: run.id, to }, `move run ${run.id}`); }
  // A list that the stand could not give when the view was opened.
  soon() { if (!this.form) { tell(this.form_answer, ""); this.load(); } }
  event() {}
  close() { this.closed = true; this.design.close(); }
}

// What it will take, or has taken.
function time_of(run) {
  if (run.began_ns && run.ended_ns) return ` after ${duration(seconds(run.ended_ns - run.began_ns))}`;
  return run.expected_s && !ENDED.includes(run.state) ? `, takes ${duration(run.expected_s)}` : "";
}
