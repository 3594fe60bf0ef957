// What each channel is called, and how its curve looks: colour, dash and label differ, so that no curve is known by its
// colour alone.

const KNOWN = {
  "regulator.sp": ["set-point", "--c-set", [8, 4], 1.6],
  "thermometers.air": ["air", "--c-air", [], 2.2],
  "camera.temperature": ["camera", "--c-camera", [], 2.2],
  "thermometers.granite_inside": ["granite inside", "--c-granite", [], 1.8],
  "thermometers.granite_outside": ["granite outside", "--c-granite2", [10, 3, 2, 3], 1.8],
  "thermometers.artifact": ["artifact", "--c-artifact", [6, 3], 1.8],
  "thermometers.laboratory": ["laboratory", "--c-laboratory", [2, 3], 1.8],
  "regulator.pv": ["regulator's sensor", "--c-air", [2, 2], 1.4],
  "regulator.mv_heat": ["heating", "--c-heat", [], 1.6],
  "regulator.mv_cool": ["cooling", "--c-cool", [6, 3], 1.6],
};
const SPARE = ["--c-camera", "--c-granite2", "--c-artifact", "--c-laboratory", "--c-granite"];
const DASHES = [[], [6, 3], [2, 3], [10, 3, 2, 3]];
const ORDER = Object.keys(KNOWN);
const FIRST_HIDDEN = new Set(["regulator.pv"]);

export function look_of(channel) {
  if (KNOWN[channel]) {
    const [name, colour, dash, width] = KNOWN[channel];
    return { name, colour, dash, width };
  }
  if (channel.endsWith(".drift_mean")) return { name: `mean drift${of(channel)}`, colour: "--c-mean", dash: [], width: 2 };
  if (channel.endsWith(".drift_worst")) return { name: `worst marker${of(channel)}`, colour: "--c-worst", dash: [6, 3], width: 1.6 };
  const sum = [...channel].reduce((total, letter) => total + letter.charCodeAt(0), 0);
  const [device, quantity] = channel.split(".");
  const name = (device === "thermometers" ? quantity : `${device} ${quantity}`).replaceAll("_", " ");
  return { name, colour: SPARE[sum % SPARE.length], dash: DASHES[sum % DASHES.length], width: 1.6 };
}

const of = (channel) => (channel.startsWith("camera.") ? "" : `, ${channel.split(".")[0]}`);

// Temperatures in the order of the stand's importance to a reader.
export function temperatures(units) {
  const found = Object.keys(units).filter((channel) => units[channel] === "degC");
  const place = (channel) => (ORDER.indexOf(channel) < 0 ? ORDER.length : ORDER.indexOf(channel));
  return found.sort((one, other) => place(one) - place(other) || one.localeCompare(other, undefined, { numeric: true }));
}

// Unit -> channels, of what is measured besides: no temperature, no flag or count (unit 1), and not on the page elsewhere.
export function further(units, axes) {
  const found = {};
  for (const channel of Object.keys(units).sort()) {
    const unit = units[channel], is_elsewhere = KNOWN[channel] || channel.includes(".drift_") || axes.includes(channel.split(".")[0]);
    if (unit !== "degC" && unit !== "1" && !is_elsewhere) (found[unit] ??= []).push(channel);
  }
  return found;
}

const HIDDEN = "thermostand.hidden";

export function hidden() {
  try {
    return new Set(JSON.parse(localStorage.getItem(HIDDEN)) ?? FIRST_HIDDEN);
  } catch {
    return new Set(FIRST_HIDDEN);
  }
}

export function set_hidden(channels) {
  try { localStorage.setItem(HIDDEN, JSON.stringify([...channels])); } catch { /* private windows keep nothing */ }
}
