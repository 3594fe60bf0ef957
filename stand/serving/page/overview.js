// All stands: a card each, those first that need somebody. STOP is passed on from here; all else is done on that stand's own page.
import { get, send, tell } from "./api.js";
import { day_clock, dated_clock, fill, h, number, seconds } from "./dom.js";

const EACH_MS = 5000;

export class Overview {
  constructor(place, app) {
    this.app = app;
    this.answer = h("p", { class: "answer", role: "status" });
    this.cards = h("div", { class: "cards" });
    this.search = h("input", { type: "search", "aria-label": "Search the sessions of all stands by date, recipe, operator, serial number, tag or note", placeholder: "date, recipe, operator, number, tag", onchange: () => this.find() });
    this.found = h("tbody");
    this.table = h("div", { class: "scroll", hidden: true }, h("table", { class: "sessions" }, h("thead", {}, h("tr", {}, ["stand", "session", "recipe", "began", "frames", "run", "camera", "tags"].map((name) => h("th", { scope: "col" }, name)))), this.found));
    this.searched = h("p", { class: "answer", role: "status" });
    fill(place, h("div", { class: "stack" }, this.answer, this.cards,
      h("section", { class: "panel" }, h("div", { class: "head" }, h("h2", {}, "Sessions of all stands"), this.search), this.searched, this.table)));
    this.load();
    this.timer = setInterval(() => this.load(), EACH_MS);
  }

  async load() {
    if (document.hidden || this.closed) return;
    let cards;
    try { cards = await get("/overview"); } catch (error) { return tell(this.answer, error.message, true); }
    if (this.closed) return;
    const text = JSON.stringify(cards.map(({ now_ns, ...rest }) => rest));
    if (text !== this.shown) fill(this.cards, cards.map((card) => this.card(card)));
    this.shown = text;
    for (const image of this.cards.querySelectorAll("img")) image.src = `${image.dataset.src}?${Math.floor(Date.now() / EACH_MS)}`;
  }

  card(card) {
    const answer = h("p", { class: "answer", role: "status" });
    const stop = h("button", { type: "button", class: "stop-stand", onclick: () => this.stop(card, answer) }, `STOP ${card.name}`);
    const path = `/api/v1/overview/${card.key}/frame.jpg`;
    const image = h("img", { alt: `The last frame of ${card.name}`, "data-src": path, hidden: true, onload: () => { image.hidden = !image.naturalWidth; }, onerror: () => { image.hidden = true; } });
    const rows = [["set-point", card.set_point_degC], ["air", card.air_degC], ["camera", card.camera_degC]].filter(([, value]) => value !== null).map(([name, value]) => [name, `${number(value, 1)} °C`]);
    if (card.steps) rows.push(["step", `${card.step} of ${card.steps}`]);
    if (card.end_ns) rows.push(["ends", day_clock(seconds(card.end_ns, card.utc_offset_ns))]);
    return h("section", { class: "panel card", "data-standing": card.standing },
      h("div", { class: "head" }, h("h2", {}, card.page ? h("a", { href: card.page }, card.name) : card.name), h("span", { class: "tag" }, card.standing), card.simulated ? h("span", { class: "tag" }, "simulated") : null),
      card.why ? h("p", { class: "level-warning" }, card.why) : null, card.doing ? h("p", {}, card.doing) : null,
      h("dl", { class: "facts" }, rows.map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)])), image, h("div", { class: "row" }, stop), answer);
  }

  async stop(card, answer) {
    tell(answer, "STOP …");
    try { tell(answer, (await send("POST", `/overview/${card.key}/stop`)).text); } catch (error) { tell(answer, error.message, true); }
  }

  async find() {
    const words = this.search.value.trim();
    if (!words) { this.table.hidden = true; return tell(this.searched, ""); }
    tell(this.searched, "searching …");
    try {
      const found = await get(`/overview/sessions?find=${encodeURIComponent(words)}`);
      fill(this.found, found.map((each) => h("tr", {}, [each.stand, each.page ? h("a", { href: `${each.page}#sessions` }, each.name) : each.name, each.recipe, each.begin_ns ? dated_clock(seconds(each.begin_ns)) : "–", String(each.frames), each.run, each.camera, each.tags.join(", ")].map((value) => h("td", {}, value)))));
      this.table.hidden = !found.length;
      tell(this.searched, found.length ? "" : "no session of these stands has all of these words");
    } catch (error) { tell(this.searched, error.message, true); }
  }

  update() {}
  soon() { this.load(); }
  event() {}
  close() { this.closed = true; clearInterval(this.timer); }
}
