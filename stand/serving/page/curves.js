// Curves over time that share a time axis: min and max of each column as a band, with marks of events and steps.
import uPlot from "./uPlot.js";
import { css } from "./dom.js";
import { look_of } from "./channels.js";

const MARK = { error: ["--bad", "▲"], warning: ["--warn", "◆"] };
const LABELS_px = 104; // to the right of the curves
const font = "12px system-ui, sans-serif";

const is_drift = (channel) => channel.includes(".drift_");

// A line goes on over the times without frames (undefined), and ends where drift begins to count from another frame (null).
function by_reference(history, channel, values) {
  const camera = channel.split(".")[0], line = values.map((value) => value ?? undefined);
  for (const { level, kind, time_ns } of history.marks) {
    const at = Math.floor((time_ns - history.from_ns) / history.width_ns);
    if (level === "reference" && kind === camera && at >= 0 && at < line.length) line[at] = null;
  }
  return line;
}

// history -> uPlot's columns: x in s, then low and high of each channel.
export function table(history, channels, offset_s) {
  const middle = history.width_ns / 2e9;
  const x = Array.from({ length: history.points }, (_, n) => (history.from_ns + n * history.width_ns) / 1e9 + middle + offset_s);
  const none = Array(history.points).fill(null);
  return [x, ...channels.flatMap((channel) => {
    const low = history.low[channel] ?? none, both = [low, history.high[channel] ?? low];
    return is_drift(channel) ? both.map((values) => by_reference(history, channel, values)) : both;
  })];
}

// options: height, channels, unit, range (min, max) or null, marks (), lane: {channel, name}, on_zoom (from_s, to_s)
export class Curves {
  constructor(place, options) {
    this.options = options;
    this.place = place;
    this.plot = null;
    this.shape = "";
    this.resizing = new ResizeObserver(() => this.fit());
    this.resizing.observe(place);
  }

  // Draws this; the plot is made again only when its channels or the colours have changed.
  show(history, channels, hidden, from_s, to_s, offset_s) {
    this.history = history;
    this.offset_s = offset_s;
    this.channels = channels;
    const shape = `${channels.join()}|${css("--ink")}`;
    const data = table(history, channels, offset_s);
    if (shape !== this.shape) {
      this.plot?.destroy();
      this.shape = shape;
      this.plot = new uPlot(this.settings(channels), data, this.place);
      this.plot.root.setAttribute("aria-hidden", "true");
    } else {
      this.plot.setData(data, false);
    }
    channels.forEach((channel, index) => {
      for (const at of [2 * index + 1, 2 * index + 2]) {
        const shown = !hidden.has(channel);
        if (this.plot.series[at].show !== shown) this.plot.setSeries(at, { show: shown }, false);
      }
    });
    this.plot.setScale("x", { min: from_s, max: to_s });
  }

  fit() {
    const width = Math.floor(this.place.clientWidth);
    if (this.plot && width > 0 && Math.abs(width - this.plot.width) > 1) this.plot.setSize({ width, height: this.options.height });
  }

  destroy() {
    this.resizing.disconnect();
    this.plot?.destroy();
    this.plot = null;
  }

  settings(channels) {
    const options = this.options;
    const axis = { stroke: css("--quiet"), font, grid: { stroke: css("--faint"), width: 1 }, ticks: { stroke: css("--line"), width: 1, size: 4 } };
    const series = channels.flatMap((channel) => {
      const look = look_of(channel);
      const line = { stroke: css(look.colour), width: look.width, dash: look.dash, points: { show: false } };
      return [{ ...line, label: look.name }, { ...line, label: `${look.name}, highest`, width: look.width * 0.6 }];
    });
    const bands = channels.map((channel, index) => ({ series: [2 * index + 2, 2 * index + 1], fill: `${css(look_of(channel).colour)}44` }));
    return {
      width: Math.max(200, Math.floor(this.place.clientWidth)),
      height: options.height,
      pxAlign: 0,
      legend: { show: false },
      padding: [16, options.labels ? LABELS_px : 12, 0, 0],
      cursor: { sync: { key: options.sync ?? "curves" }, drag: { x: true, y: false, setScale: false }, points: { size: 6 } },
      select: { show: true },
      scales: { x: { time: options.time !== false }, y: { range: options.range ?? padded } },
      axes: [
        { ...axis, show: options.axis !== false, size: 26, values: options.values ?? times, space: 70 },
        { ...axis, size: 52, label: undefined, values: (plot, ticks) => ticks.map((tick) => (plot.is_empty ? "" : short(tick))), space: options.space ?? 28 },
      ],
      series: [{}, ...series],
      bands,
      hooks: {
        draw: [(plot) => this.draw(plot)],
        setSelect: [(plot) => this.zoom(plot)],
        setCursor: [(plot) => options.on_cursor?.(plot)],
      },
    };
  }

  zoom(plot) {
    const { left, width } = plot.select;
    if (width < 6) return;
    const from_s = plot.posToVal(left, "x"), to_s = plot.posToVal(left + width, "x");
    plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    this.options.on_zoom?.(from_s, to_s);
  }

  draw(plot) {
    const context = plot.ctx;
    const { left, top, width, height } = plot.bbox;
    const scale = devicePixelRatio;
    context.save();
    context.beginPath();
    context.rect(left, top - 14 * scale, width, height + 14 * scale);
    context.clip();
    if (this.options.lane) this.draw_lane(plot, context, left, top, width, height, scale);
    if (this.options.marks) this.draw_marks(plot, context, top, height, scale);
    context.restore();
    if (this.options.labels) this.draw_labels(plot, context, left + width, top, height, scale);
    if (this.options.unit) {
      context.save();
      context.fillStyle = css("--quiet");
      context.font = `${12 * scale}px system-ui, sans-serif`;
      context.textAlign = "left";
      context.fillText(this.options.unit, 2 * scale, top + 4 * scale);
      context.restore();
    }
  }

  draw_marks(plot, context, top, height, scale) {
    context.font = `${12 * scale}px system-ui, sans-serif`;
    context.textAlign = "center";
    for (const mark of this.history.marks) {
      const look = MARK[mark.level];
      if (!look) continue;
      const x = plot.valToPos(mark.time_ns / 1e9 + this.offset_s, "x", true);
      context.strokeStyle = context.fillStyle = css(look[0]);
      context.lineWidth = scale;
      context.setLineDash([3 * scale, 3 * scale]);
      context.beginPath();
      context.moveTo(x, top);
      context.lineTo(x, top + height);
      context.stroke();
      context.fillText(look[1], x, top - 2 * scale);
    }
    context.setLineDash([]);
  }

  // The name of each curve at its end; those that would lie over one another are moved apart.
  draw_labels(plot, context, right, top, height, scale) {
    const ends = [];
    this.channels.forEach((channel, index) => {
      const values = plot.data[2 * index + 1];
      if (!plot.series[2 * index + 1].show) return;
      for (let at = values.length - 1; at >= 0; at -= 1) {
        if (values[at] === null) continue;
        if (plot.data[0][at] >= plot.scales.x.min) ends.push({ look: look_of(channel), y: plot.valToPos(values[at], "y", true) });
        break;
      }
    });
    ends.sort((one, other) => one.y - other.y);
    const line = 14 * scale;
    ends.forEach((each, n) => { if (n && each.y < ends[n - 1].y + line) each.y = ends[n - 1].y + line; });
    for (let n = ends.length - 1, below = Infinity; n >= 0; n -= 1) { ends[n].y = Math.min(ends[n].y, below, top + height - line / 2); below = ends[n].y - line; }
    context.save();
    context.font = `${12 * scale}px system-ui, sans-serif`;
    context.textAlign = "left";
    context.textBaseline = "middle";
    for (const { look, y } of ends) {
      context.fillStyle = css(look.colour);
      context.fillText(fitting(context, look.name, (LABELS_px - 8) * scale), right + 6 * scale, y);
    }
    context.restore();
  }

  // A strip at the bottom that is filled while a flag is on.
  draw_lane(plot, context, left, top, width, height, scale) {
    const { channel, name } = this.options.lane;
    const values = this.history.high[channel] ?? this.history.low[channel];
    const thick = 9 * scale, y = top + height - thick;
    context.fillStyle = css("--faint");
    context.fillRect(left, y, width, thick);
    context.fillStyle = css("--c-cool");
    if (values) {
      const wide = plot.valToPos(this.history.width_ns / 1e9, "x", true) - plot.valToPos(0, "x", true);
      values.forEach((value, n) => {
        if (value > 0) context.fillRect(plot.valToPos(plot.data[0][n], "x", true) - wide / 2, y, wide + 0.6, thick);
      });
    }
    context.fillStyle = css("--ink");
    context.font = `${11 * scale}px system-ui, sans-serif`;
    context.textAlign = "left";
    context.fillText(name, left + 4 * scale, y - 3 * scale);
  }
}

// A name that is too long keeps its beginning and its end, in which names of one kind differ.
function fitting(context, name, width) {
  let text = name;
  for (let kept = name.length - 1; kept > 1 && context.measureText(text).width > width; kept -= 1) {
    const half = Math.ceil(kept / 2);
    text = `${name.slice(0, half)}…${name.slice(name.length - kept + half)}`;
  }
  return text;
}

const short = (value) => (Number.isInteger(value) ? String(value) : String(Math.round(value * 1000) / 1000)).replace("-", "−");

// Local time on 24 hours; the day where there is a midnight, or where days are what is shown.
function times(_, ticks, _axis, _space, step_s) {
  return ticks.map((tick) => {
    const date = new Date(tick * 1000), is_midnight = !date.getHours() && !date.getMinutes();
    if (step_s >= 86400 || (is_midnight && step_s >= 1800)) return date.toLocaleDateString([], { weekday: "short", day: "numeric" });
    const two = (value) => String(value).padStart(2, "0");
    return `${two(date.getHours())}:${two(date.getMinutes())}${step_s < 60 ? `:${two(date.getSeconds())}` : ""}`;
  });
}

// At least half a unit high, so that noise does not fill the panel.
function padded(plot, low, high) {
  plot.is_empty = low === null || high === null; // an axis of nothing has no numbers
  if (plot.is_empty) return [0, 1];
  const margin = Math.max((high - low) * 0.08, 0.05), least = plot.series.length > 6 ? 2 : 0.02;
  const more = Math.max(0, least - (high - low)) / 2;
  return [low - margin - more, high + margin + more];
}
