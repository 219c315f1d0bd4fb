// The page: its state, and who is told when it changes.
import * as api from "./api.js";
import { Picture } from "./canvas.js";
import { Dial } from "./dial.js";
import { History } from "./history.js";
import { HELP, number, objects, put, say, showNumbers } from "./panel.js";
import { Tools } from "./tools.js";

const $ = (id) => document.getElementById(id);
const photo = new Image();
photo.src = "photo.png";
const [first] = await Promise.all([api.state(), photo.decode()]);

let state = first; // what the file says
const history = new History({ edit: first.edit, mask: null });
const picture = new Picture($("canvas"), photo, first.size, first.shown);
const layer = Object.assign(document.createElement("canvas"), { width: first.shown[0], height: first.shown[1] });
let grid = first.view.grid;
let gridOf = "";
let draft = null;
let light = null;

const page = {
  picture, history, view: first.view, chosen: 0,

  redraw() {
    const { chosen, view } = page;
    picture.draw(view, { draft, grid, mask: layer, chosen, showGrid: $("show").checked, tool: tools.name });
    tools.draw();
  },

  choose(k) {
    page.chosen = Math.max(0, Math.min(k, history.now.edit.objects.length - 1));
    refresh();
  },

  // Changes keys of the chosen object; for good if `done`.
  change(keys, done) {
    const list = [...history.now.edit.objects];
    if (!list[page.chosen]) return;
    list[page.chosen] = { ...list[page.chosen], ...keys };
    edit({ objects: list }, done);
  },

  // Ends a drag that began at `before`.
  finish(before) {
    history.commit(history.now, before);
    refresh();
  },

  copy() {
    const list = [...history.now.edit.objects];
    const [x, y] = list[page.chosen].at ?? page.view.objects[page.chosen]?.contact ?? [0, 0];
    const aside = 60 / picture.scale;
    list.splice(page.chosen + 1, 0, { ...list[page.chosen], at: [Math.min(x + aside, state.size[0] - 1), y] });
    edit({ objects: list }, true);
    page.choose(page.chosen + 1);
  },

  remove() {
    if (history.now.edit.objects.length < 2) return say("A scene needs an object.", true);
    edit({ objects: history.now.edit.objects.filter((_, k) => k !== page.chosen) }, true);
    page.choose(page.chosen - 1);
  },

  linesChanged() {
    if (tools.name === "lines") solve();
  },

  // Draws a stroke into the mask; sends it when the stroke ends.
  paint(from, to, ends) {
    if (ends) return takeMask();
    const context = layer.getContext("2d");
    const scale = first.shown[0] / first.size[0];
    context.globalCompositeOperation = $("erase").checked ? "destination-out" : "source-over";
    context.strokeStyle = "#ff2f6d";
    context.lineCap = "round";
    context.lineWidth = ($("brush").valueAsNumber / picture.scale) * scale;
    context.beginPath();
    context.moveTo(from[0] * scale, from[1] * scale);
    context.lineTo(to[0] * scale + 0.01, to[1] * scale);
    context.stroke();
    page.redraw();
  },
};
const tools = new Tools(page, first.size);

function edit(keys, done, mask = history.now.mask) {
  const next = { edit: { ...history.now.edit, ...keys }, mask };
  done ? history.commit(next) : history.show(next);
  refresh();
}

const look = api.latest(async (edit) => {
  const key = JSON.stringify([edit.turn, edit.height_m]);
  try {
    const view = await api.ask("view", { edit, grid: key !== gridOf });
    page.view = view;
    if (view.grid) [grid, gridOf] = [view.grid, key];
    if ($("status").classList.contains("bad")) say("");
  } catch (error) {
    return say(error.message, true);
  }
  showNumbers(page.view, page.chosen);
  page.redraw();
});

let soon = 0;
// A coarse picture soon and a fine one after it; `data-samples` of the canvas says which one is shown.
function render() {
  clearTimeout(soon);
  delete $("canvas").dataset.samples;
  soon = setTimeout(() => shoot(4), 90);
}

async function shoot(samples) {
  const { edit } = history.now;
  try {
    const found = await api.draft(edit, samples);
    if (found === undefined) return;
    showPicture(found);
    if (edit !== history.now.edit) return; // a picture of the newer one follows
    $("canvas").dataset.samples = samples;
    if (samples < 32) soon = setTimeout(() => shoot(32), 700);
    else await api.relight(edit); // records, so that the sun turns at once
  } catch (error) {
    say(error.message, true);
  }
}

function showPicture(found) {
  draft = found;
  light = found?.light ?? light;
  showLight();
  page.redraw();
}

const relight = api.latest(async (edit) => {
  try {
    const found = await api.relight(edit);
    if (found !== undefined) showPicture(found);
  } catch (error) {
    say(error.message, true);
  }
  // The last one that was dragged may have broken off the draft that followed.
  if (!beforeSun && !beforeExposure) render();
});

let beforeSun = null; // while the sun is dragged: what undo leads to
let beforeExposure = null;

// Shows another sun or exposure while it is dragged.
function showLit(keys) {
  history.show({ ...history.now, edit: { ...history.now.edit, ...keys } });
  clearTimeout(soon);
  delete $("canvas").dataset.samples;
  showLight();
  relight(history.now.edit);
}

function showLight() {
  const said = history.now.edit.sun;
  const sun = said ?? light?.sun ?? null;
  dial.draw(sun, Boolean(said));
  put("azimuth", sun?.azimuth_deg, 0);
  put("elevation", sun?.elevation_deg, 0);
  const effect = light?.fixed ? "; a sun that is set here does not change it" : sun ? "" : ", no sun";
  $("origin").textContent = light ? `Light: ${light.origin}${effect}` : "";
  const stops = history.now.edit.exposure_ev ?? state.exposure_ev;
  $("exposure").value = stops;
  $("stops").textContent = `${stops >= 0 ? "+" : ""}${stops.toFixed(1)}`;
}

function refresh() {
  const { edit } = history.now;
  page.chosen = Math.min(page.chosen, edit.objects.length - 1);
  objects(state.names, edit, page.chosen, page.choose);
  $("undo").disabled = !history.past.length;
  $("redo").disabled = !history.future.length;
  $("remove").disabled = edit.objects.length < 2;
  showLight();
  look(edit);
  render();
}

async function takeMask() {
  const data = layer.getContext("2d").getImageData(0, 0, layer.width, layer.height).data;
  const mask = new Uint8ClampedArray(layer.width * layer.height).map((_, k) => data[4 * k + 3]);
  if (await setMask(mask)) edit({ mask: true }, true, mask);
}

// Shows a mask and sends it; whether it arrived.
async function setMask(mask) {
  const context = layer.getContext("2d");
  const image = context.createImageData(layer.width, layer.height);
  mask.forEach((value, k) => image.data.set([255, 47, 109, value], 4 * k));
  context.putImageData(image, 0, 0);
  try {
    await api.sendMask(mask);
    return true;
  } catch (error) {
    say(error.message, true);
    return false;
  }
}

async function step(way) {
  if (saving) return;
  const before = history.now.mask;
  if (!history[way]()) return;
  if (history.now.mask !== before) await setMask(history.now.mask ?? ownMask());
  refresh();
}

function linesNow() {
  const [a, b, c, d] = tools.lines.lines;
  return { first: [a, b], second: tools.second ? [c, d] : null, direction: $("direction").value };
}

let solved = null;
const solve = api.latest(async () => {
  try {
    solved = await api.ask("solve", { edit: history.now.edit, lines: linesNow() });
    const { turn, uncertain_deg: by } = solved;
    $("solved").textContent =
      `pitch ${turn.pitch_deg.toFixed(1)}° ± ${by.pitch_deg.toFixed(1)}°, roll ${turn.roll_deg.toFixed(1)}° ± ` +
      `${by.roll_deg.toFixed(1)}°, field of view ${turn.fov_deg.toFixed(1)}°` +
      (solved.found_fov ? ` ± ${by.fov_deg.toFixed(1)}°` : " as before");
  } catch (error) {
    solved = null;
    $("solved").textContent = error.message;
  }
  $("use-lines").disabled = !solved;
});

let saving = false;

// Sizes are factors on those of the file: what is sent twice is applied twice, and what is changed meanwhile is lost.
async function save() {
  if (saving) return;
  saving = true;
  const main = document.querySelector("main");
  const field = document.activeElement;
  if (field?.matches("input")) field.blur(); // takes what is being typed
  main.inert = true;
  try {
    const { written, state: next } = await api.ask("save", history.now.edit);
    state = next;
    history.reset({ edit: next.edit, mask: null });
    if (written.some((path) => path.endsWith(".png"))) own = await api.ownMask();
    page.view = next.view;
    say(`Wrote ${written.join(" and ")}. dipir run makes the picture.`);
    refresh();
  } catch (error) {
    say(error.message, true);
  } finally {
    saving = false;
    main.inert = false;
    field?.focus({ preventScroll: true });
  }
}

let own = await api.ownMask();
const ownMask = () => (own.length ? own : new Uint8ClampedArray(layer.width * layer.height));
if (own.length) {
  const context = layer.getContext("2d");
  const image = context.createImageData(layer.width, layer.height);
  own.forEach((value, k) => image.data.set([255, 47, 109, value], 4 * k));
  context.putImageData(image, 0, 0);
}

// The sun, by hand: until the pointer is let go it is only shown.
const dial = new Dial($("dial"), (sun, done) => {
  beforeSun ??= history.now;
  showLit({ sun, shadow: null });
  if (done) {
    history.commit(history.now, beforeSun);
    beforeSun = null;
    refresh();
  }
});
const sunNow = () => history.now.edit.sun ?? light?.sun ?? { azimuth_deg: 0, elevation_deg: 45 };
number("azimuth", (v) => edit({ sun: { ...sunNow(), azimuth_deg: v }, shadow: null }, true));
number("elevation", (v) => edit({ sun: { ...sunNow(), elevation_deg: v }, shadow: null }, true));
number("yaw", (v) => page.change({ yaw_deg: v }, true));
number("height", (v) => {
  const now = page.view.objects[page.chosen]?.size_m[1];
  const size = history.now.edit.objects[page.chosen].size ?? 1;
  if (v > 0 && now > 0) page.change({ size: (size * v) / now }, true);
});
$("exposure").addEventListener("input", (event) => {
  beforeExposure ??= history.now;
  showLit({ exposure_ev: event.target.valueAsNumber });
});
$("exposure").addEventListener("change", () => {
  history.commit(history.now, beforeExposure ?? history.now);
  beforeExposure = null;
  refresh();
});
$("copy").addEventListener("click", () => page.copy());
$("remove").addEventListener("click", () => page.remove());
$("undo").addEventListener("click", () => step("undo"));
$("redo").addEventListener("click", () => step("redo"));
$("save").addEventListener("click", save);
$("show").addEventListener("change", () => page.redraw());
$("direction").addEventListener("change", () => solve());
$("second").addEventListener("change", (event) => {
  tools.second = event.target.checked;
  solve();
  page.redraw();
});
$("use-lines").addEventListener("click", () => solved && edit({ turn: solved.turn }, true));
$("use-measure").addEventListener("click", async () => {
  const [ends] = tools.measure.lines;
  try {
    const body = { edit: history.now.edit, ends, length_m: $("length").valueAsNumber };
    const { height_m } = await api.ask("measure", body);
    edit({ height_m }, true);
    say(`The camera stands ${height_m.toFixed(2)} m above the ground.`);
  } catch (error) {
    say(error.message, true);
  }
});
$("use-shadow").addEventListener("click", () => {
  const [[foot, tip]] = tools.shadow.lines;
  const height = $("tall").valueAsNumber;
  edit({ sun: null, shadow: { foot: [...foot], tip: [...tip], height_m: height > 0 ? height : null } }, true);
});
$("clear").addEventListener("click", async () => {
  const mask = new Uint8ClampedArray(layer.width * layer.height);
  if (await setMask(mask)) edit({ mask: true }, true, mask);
});
for (const input of document.querySelectorAll("#tools input")) {
  input.addEventListener("change", () => {
    tools.name = input.value;
    for (const panel of document.querySelectorAll(".tool")) panel.hidden = panel.id !== `panel-${input.value}`;
    $("help").textContent = HELP[input.value];
    if (input.value === "lines") solve();
    page.redraw();
  });
}
window.addEventListener("keydown", (event) => {
  if (!(event.ctrlKey || event.metaKey)) return;
  const act = { z: () => step(event.shiftKey ? "redo" : "undo"), y: () => step("redo"), s: save }[event.key.toLowerCase()];
  if (!act || event.target.matches?.("input[type=number]") && event.key !== "s") return;
  event.preventDefault();
  act();
});
window.addEventListener("resize", () => {
  picture.fit();
  page.redraw();
});
window.addEventListener("contextmenu", (event) => event.target === picture.canvas && event.preventDefault());
window.addEventListener("beforeunload", (event) => history.past.length && event.preventDefault());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", showLight);

$("file").textContent = first.file;
$("help").textContent = HELP.move;
document.documentElement.dataset.ready = "yes";
refresh();
showNumbers(page.view, page.chosen);
page.redraw();
