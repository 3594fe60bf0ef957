// The last frame with the markers found in it and how far each has moved, a hundred times enlarged.
import { get } from "./api.js";
import { clock, css, fill, h, number, say, seconds } from "./dom.js";

const TIMES = 100;
const EACH_MS = 500;

export class FramePanel {
  constructor(place, app, is_setup) {
    this.app = app;
    this.is_setup = is_setup;
    this.camera = "";
    this.picture = null;
    this.canvas = h("canvas", { role: "img", "aria-label": "The last frame", width: 612, height: 512 });
    this.caption = h("small", {}, "no frame yet");
    this.facts = h("dl", { class: "facts" });
    this.choice = h("select", { "aria-label": "Camera", hidden: true, onchange: () => { this.camera = this.choice.value; this.time_ns = null; this.soon(); } });
    place.append(h("section", { class: "panel" },
      h("div", { class: "head" }, h("h2", {}, "Last frame"), this.choice, this.caption),
      this.none = h("p", { class: "quiet" }, "The next frame of a run is shown here, and one that is taken under Devices."),
      this.box = h("div", { class: "frame", hidden: true }, this.canvas), this.facts));
    this.timer = setTimeout(() => this.refresh(), 0);
  }

  soon() { clearTimeout(this.timer); this.timer = setTimeout(() => this.refresh(), 50); }

  async refresh() {
    clearTimeout(this.timer);
    try {
      if (!document.hidden && !this.closed && !this.app.is_lost) await this.fetch();
    } catch (error) {
      say(this.caption, error.message);
    }
    if (!this.closed) this.timer = setTimeout(() => this.refresh(), this.frame ? EACH_MS : 2000);
  }

  async fetch() {
    const query = this.camera ? `?camera=${encodeURIComponent(this.camera)}` : "";
    const frame = await get(`/frame${query}`);
    if (!frame) return say(this.caption, "no frame yet");
    if (frame.time_ns === this.time_ns) return;
    const answer = await fetch(`/api/v1/frame.jpg${query}`);
    if (!answer.ok || this.closed) return;
    const picture = await createImageBitmap(await answer.blob());
    this.picture?.close(); // pictures are not left to the collector: a session has 7,200 of them
    this.picture = picture;
    this.time_ns = frame.time_ns;
    this.frame = frame;
    this.box.hidden = false;
    this.none.hidden = true;
    this.draw();
    this.show();
  }

  draw() {
    const { frame, picture, canvas } = this;
    if (canvas.width !== picture.width || canvas.height !== picture.height) {
      canvas.width = picture.width;
      canvas.height = picture.height;
    }
    const context = canvas.getContext("2d"), scale = picture.width / frame.width;
    context.drawImage(picture, 0, 0);
    const unit = Math.max(1, picture.width / 600);
    context.lineWidth = 2 * unit;
    for (const [, x, y, dx, dy] of frame.markers) {
      const at_x = (x + 0.5) * scale, at_y = (y + 0.5) * scale;
      context.strokeStyle = "#56b4e9";
      context.beginPath();
      context.arc(at_x, at_y, 5 * unit, 0, 2 * Math.PI);
      context.stroke();
      if (dx !== null) arrow(context, at_x, at_y, dx * TIMES * scale, dy * TIMES * scale, unit);
    }
  }

  show() {
    const { frame, facts } = this;
    const when = clock(seconds(frame.time_ns, this.app.state?.utc_offset_ns ?? 0), true);
    say(this.caption, `${when}${frame.role ? `, ${frame.role.replaceAll("_", " ")}` : ""}`);
    const drift = frame.mean_px === null ? "no drift of this frame is known" : `mean drift ${number(frame.mean_px * 1000, 0)} millipixels`;
    this.canvas.setAttribute("aria-label", `The last frame: ${frame.markers.length} markers found; ${drift}`);
    if (this.choice.options.length !== frame.cameras.length) {
      fill(this.choice, frame.cameras.map((name) => h("option", { value: name }, name)));
      this.choice.hidden = frame.cameras.length < 2;
      this.choice.value = frame.camera;
    }
    const found = frame.expected ? `${frame.markers.length} of ${frame.expected}` : frame.trouble || "none";
    const rows = [["markers found", found]];
    if (frame.mean_px !== null) {
      rows.push([`mean drift, drawn × ${TIMES}`, `${number(frame.mean_px, 3)} px  (${number(frame.mean_dx, 3)}, ${number(frame.mean_dy, 3)})`],
        ["worst marker", `${number(frame.worst_px, 3)} px, number ${frame.worst}`],
        ["since the reference of", clock(seconds(frame.reference_ns, this.app.state?.utc_offset_ns ?? 0), true)]);
    }
    if (this.is_setup && frame.skipped) rows.push(["frames not looked at", String(frame.skipped)]);
    fill(facts, rows.map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));
    this.on_frame?.(frame);
  }

  close() {
    this.closed = true;
    clearTimeout(this.timer);
    this.picture?.close();
  }
}

// Black under orange: it shows on the white target and on its black discs.
function arrow(context, x, y, dx, dy, unit) {
  const length = Math.hypot(dx, dy);
  if (length < 2) return;
  const head = Math.min(7 * unit, length / 2), angle = Math.atan2(dy, dx);
  for (const [colour, width] of [["#000000", 4.5 * unit], ["#f0a13a", 2.2 * unit]]) {
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(x + dx, y + dy);
    for (const turn of [2.6, -2.6]) {
      context.moveTo(x + dx, y + dy);
      context.lineTo(x + dx + head * Math.cos(angle + turn), y + dy + head * Math.sin(angle + turn));
    }
    context.stroke();
  }
}

// The view for setting a camera up: light, focus and tilt, as of the last frame.
export class CameraView {
  constructor(place, app) {
    const left = h("div", { class: "stack" });
    this.right = h("div", { class: "stack" });
    fill(place, h("div", { class: "grid" }, left, this.right));
    this.histogram = h("canvas", { role: "img", "aria-label": "Histogram of the last frame", width: 640, height: 180, class: "line" });
    this.histogram.style.height = "110px";
    this.light = h("dl", { class: "facts" });
    this.focus = h("dl", { class: "facts" });
    this.tilt = h("dl", { class: "facts" });
    this.aids = [
      h("section", { class: "panel" }, h("h2", {}, "Light"), this.histogram, h("p", { class: "quiet" }, "number of pixels (logarithmic) from black to white"), this.light),
      h("section", { class: "panel" }, h("h2", {}, "Focus"), this.focus),
      h("section", { class: "panel" }, h("h2", {}, "Target against camera"), this.tilt, h("p", { class: "quiet" }, "Both keystones are 0 when camera and target face each other. The tilt is found from some degrees on."))];
    this.frame = new FramePanel(left, app, true);
    this.sharpest = null;
    this.frame.on_frame = (frame) => this.show(frame);
  }

  show({ setup }) {
    fill(this.right, this.aids);
    this.draw(setup.histogram);
    const part = (share) => (share === 0 ? "none" : share < 0.0001 ? "below 0.01 %" : `${number(share * 100, 2)} %`);
    facts(this.light, [
      ["pixels at the upper end", `${part(setup.saturated)}${setup.saturated > 0.001 ? " – shorten the exposure" : ""}`],
      ["pixels at zero", part(setup.dark)],
      ["marker contrast", setup.contrast_DN === null ? "–" : `${number(setup.contrast_DN, 0)} DN`]]);
    if (setup.edge_px !== null) this.sharpest = Math.min(this.sharpest ?? Infinity, setup.edge_px);
    facts(this.focus, [
      ["edge width, 10 to 90 %", setup.edge_px === null ? "–" : `${number(setup.edge_px, 2)} px`],
      ["sharpest since this view was opened", this.sharpest === null ? "–" : `${number(this.sharpest, 2)} px`]]);
    facts(this.tilt, [
      ["right end larger than left", setup.keystone_x_percent === null ? "–" : `${number(setup.keystone_x_percent, 2)} %`],
      ["lower end larger than upper", setup.keystone_y_percent === null ? "–" : `${number(setup.keystone_y_percent, 2)} %`],
      ["tilt", setup.tilt_deg === null ? "too small to tell" : `${number(setup.tilt_deg, 1)}°`],
      ["roll", setup.roll_deg === null ? "–" : `${number(setup.roll_deg, 2)}°`]]);
  }

  draw(shares) {
    const { histogram } = this, context = histogram.getContext("2d");
    const { width, height } = histogram, wide = width / shares.length;
    context.clearRect(0, 0, width, height);
    shares.forEach((share, n) => {
      const tall = share > 0 ? Math.max(2, (1 + Math.log10(Math.max(share, 1e-6)) / 6) * height) : 0;
      context.fillStyle = n === shares.length - 1 ? css("--bad") : css("--accent");
      context.fillRect(n * wide, height - tall, wide - 1, tall);
    });
    context.fillStyle = css("--line");
    context.fillRect(0, height - 1, width, 1);
  }

  update() {}
  soon() { this.frame.soon(); }
  event() { this.frame.soon(); }
  close() { this.frame.close(); }
}

function facts(place, rows) {
  fill(place, rows.map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));
}
