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
async function read() {
  const [first, own] = await Promise.all([api.state(), api.ownMask()]);
  await photo.decode();
  return [first, own];
}
let [first, own] = await read().catch((error) => {
  say(error.message, true);
  throw error;
});

let state = first; // what the file says
const history = new History({ edit: first.edit, mask: null });
const picture = new Picture($("canvas"), photo, first);
const layer = Object.assign(document.createElement("canvas"), { width: first.shown[0], height: first.shown[1] });
const ink = layer.getContext("2d", { willReadFrequently: true });
let grid = first.view.grid;
let gridOf = "";
let draft = null;
let light = null;

const page = {
  picture, history, view: first.view, chosen: 0,
  viewOf: first.edit, // the edit that `view` shows
  refused: false, // whether the last edit cannot be; `view` shows one before it then

  redraw() {
    const { chosen, view } = page;
    picture.draw(view, { draft, grid, mask: layer, chosen, showGrid: $("show").checked, tool: tools.name });
    tools.draw();
  },

  choose(k) {
    page.chosen = Math.max(0, Math.min(k, history.now.edit.objects.length - 1));
    refresh();
  },

  // Where the chosen object stands and how it is turned. What is shown may be older than the last change.
  pose() {
    const shown = page.view.objects[page.chosen];
    const told = page.refused ? {} : history.now.edit.objects[page.chosen];
    return { contact: told.at ?? shown?.contact, yaw: told.yaw_deg ?? shown?.yaw_deg };
  },

  // Changes keys of the chosen object; for good if `done`. Changes of one `kind` are undone as one.
  change(keys, done, kind) {
    const list = [...history.now.edit.objects];
    if (!list[page.chosen]) return;
    list[page.chosen] = { ...list[page.chosen], ...keys };
    edit({ objects: list }, done, kind && `${kind} ${page.chosen}`);
  },

  // Ends a drag that began at `before`.
  finish(before) {
    history.commit(history.now, before);
    refresh();
  },

  copy() {
    const [x, y] = page.pose().contact ?? [0, 0];
    const at = [Math.min(x + 60 / picture.scale, state.size[0] - 1), y];
    list((all, k) => all.toSpliced(k + 1, 0, { ...all[k], at }));
    page.choose(page.chosen + 1);
  },

  remove() {
    if (history.now.edit.objects.length < 2) return say("A scene needs an object.", true);
    list((all, k) => all.toSpliced(k, 1));
    page.choose(page.chosen - 1);
  },

  linesChanged() {
    if (tools.name === "lines") solve();
  },

  // Width of the brush, pixels of the screen.
  brush: () => $("brush").valueAsNumber,

  // Draws a stroke into the mask; sends it when the stroke ends.
  paint(from, to, ends) {
    if (ends) return takeMask();
    const scale = first.shown[0] / first.size[0];
    ink.globalCompositeOperation = $("erase").checked ? "destination-out" : "source-over";
    ink.strokeStyle = "#ff2f6d";
    ink.lineCap = "round";
    ink.lineWidth = (page.brush() / picture.scale) * scale;
    ink.beginPath();
    ink.moveTo(from[0] * scale, from[1] * scale);
    ink.lineTo(to[0] * scale + 0.01, to[1] * scale);
    ink.stroke();
    page.redraw();
  },
};
const tools = new Tools(page, first.size);

function edit(keys, done, kind, mask = history.now.mask) {
  const next = { edit: { ...history.now.edit, ...keys }, mask };
  done ? history.commit(next, undefined, kind) : history.show(next);
  refresh();
}

// Changes which objects there are, in what is shown, too, until the server answers.
function list(change) {
  const { view, viewOf, chosen } = page;
  const { objects } = history.now.edit;
  if (view.objects.length === objects.length) {
    page.view = { ...view, objects: change(view.objects, chosen) };
    page.viewOf = { ...viewOf, objects: change(viewOf.objects, chosen) };
  }
  edit({ objects: change(objects, chosen) }, true);
}

const typed = new WeakSet(); // edits that number fields made
let kept = null; // the edit beside which a refusal stays

// Makes an edit of a number that was typed.
function enter(make) {
  make();
  typed.add(history.now.edit);
}

// Says why an edit cannot be. A number that was typed gives way to the one before it.
function refuse(edit, error) {
  say(error.message, true);
  if (edit !== history.now.edit || !error.refused || !typed.has(edit) || !history.drop()) return;
  kept = history.now.edit;
  refresh();
}

const look = api.latest(async (edit) => {
  const key = JSON.stringify([edit.turn, edit.height_m]);
  try {
    const view = await api.ask("view", { edit, grid: key !== gridOf });
    if (view.objects.length !== history.now.edit.objects.length) return; // a newer one follows
    Object.assign(page, { view, viewOf: edit, refused: false });
    if (view.grid) [grid, gridOf] = [view.grid, key];
    if ($("status").classList.contains("bad") && edit !== kept) say("");
  } catch (error) {
    page.refused = true;
    return refuse(edit, error);
  }
  page.linesChanged();
  showNumbers(page.view, page.chosen);
  page.redraw();
});

let soon = 0;
let aim = null; // the edit whose picture is shown or under way
// A coarse picture soon and a fine one after it; `data-samples` of the canvas says which one is shown.
function render() {
  aim = history.now.edit;
  clearTimeout(soon);
  delete $("canvas").dataset.samples;
  soon = setTimeout(() => shoot(4), 90);
}

async function shoot(samples) {
  const { edit } = history.now;
  try {
    const found = await api.draft(edit, samples);
    if (found === undefined) return;
    showPicture(found, edit);
    if (edit !== history.now.edit) return; // a picture of the newer one follows
    $("canvas").dataset.samples = samples;
    if (samples < 32) soon = setTimeout(() => shoot(32), 700);
    else await api.relight(edit); // records, so that the sun turns at once
  } catch (error) {
    if (edit !== history.now.edit) return;
    aim = null;
    refuse(edit, error);
  }
}

function showPicture(found, { shadow }) {
  draft = found;
  if (found) light = { ...found.light, shadow: shadow ?? state.shadow };
  showLight();
  page.redraw();
}

const relight = api.latest(async (edit) => {
  try {
    const found = await api.relight(edit);
    if (found !== undefined) showPicture(found, edit);
  } catch (error) {
    if (edit === history.now.edit) say(error.message, true);
  }
  // The last one that was dragged may have broken off the draft that followed.
  if (!beforeSun && !beforeExposure) render();
});

let beforeSun = null; // while the sun is dragged: what undo leads to
let beforeExposure = null;
const dragged = () => tools.pointers.size > 0 || tools.isDown || beforeSun || beforeExposure;

// Shows another sun or exposure while it is dragged.
function showLit(keys) {
  history.show({ ...history.now, edit: { ...history.now.edit, ...keys } });
  aim = null;
  clearTimeout(soon);
  delete $("canvas").dataset.samples;
  showLight();
  relight(history.now.edit);
}

function showLight() {
  const said = history.now.edit.sun;
  const sun = said ?? light?.sun ?? null;
  dial.draw(sun, Boolean(said ?? light?.told));
  put("azimuth", sun?.azimuth_deg, 0);
  put("elevation", sun?.elevation_deg, 0);
  const none = light?.shadow ? "; the shadow does not tell well enough where the sun is" : ", no sun";
  const effect = light?.fixed ? "; a sun that is set here does not change it" : sun ? "" : none;
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
  if (edit !== aim) render();
}

function takeMask() {
  const data = ink.getImageData(0, 0, layer.width, layer.height).data;
  const mask = new Uint8ClampedArray(layer.width * layer.height).map((_, k) => data[4 * k + 3]);
  setMask(mask, () => edit({ mask: true }, true, undefined, mask));
}

function showMask(mask) {
  const image = ink.createImageData(layer.width, layer.height);
  new Uint32Array(image.data.buffer).set(Uint32Array.from(mask, (value) => (value << 24) | 0x6d2fff));
  ink.putImageData(image, 0, 0);
}

let masks = Promise.resolve();

// Shows a mask and sends it after those before it; `then` follows if it arrives.
function setMask(mask, then) {
  showMask(mask);
  masks = masks.then(async () => {
    try {
      await api.sendMask(mask);
      then?.();
    } catch (error) {
      say(error.message, true);
    }
  });
  return masks;
}

async function step(way) {
  if (saving || dragged()) return;
  const before = history.now.mask;
  if (!history[way]()) return;
  say(""); // what was said of the change that is undone
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
  if (dragged()) return say("Let go first, then save.");
  saving = true;
  const main = document.querySelector("main");
  const field = document.activeElement;
  if (field?.matches("input")) field.blur(); // takes what is being typed
  main.inert = true;
  say("Saving …");
  try {
    await masks;
    const { edit, mask } = history.now;
    if (edit.mask) await api.sendMask(mask); // another tab may have sent its own
    const { written, state: next } = await api.ask("save", edit);
    state = next;
    history.reset({ edit: next.edit, mask: null });
    Object.assign(page, { view: next.view, viewOf: next.edit, refused: false });
    if (written.some((path) => path.endsWith(".png"))) own = mask;
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

const ownMask = () => (own.length ? own : new Uint8ClampedArray(layer.width * layer.height));
showMask(ownMask());

// The sun, by hand: until the pointer is let go it is only shown.
const dial = new Dial($("dial"), (sun, done, kind) => {
  beforeSun ??= history.now;
  showLit({ sun, shadow: null });
  if (done) {
    history.commit(history.now, beforeSun, kind);
    beforeSun = null;
    refresh();
  }
});
const sunNow = () => history.now.edit.sun ?? light?.sun ?? { azimuth_deg: 0, elevation_deg: 45 };
const sunAt = (keys) => enter(() => edit({ sun: { ...sunNow(), ...keys }, shadow: null }, true));
number("azimuth", (v) => sunAt({ azimuth_deg: v }));
number("elevation", (v) => sunAt({ elevation_deg: v }));
number("yaw", (v) => enter(() => page.change({ yaw_deg: v }, true)));
number("height", (v) => {
  const now = page.view.objects[page.chosen]?.size_m[1];
  const size = page.viewOf.objects[page.chosen]?.size ?? 1;
  if (!(v > 0 && now > 0)) return false;
  enter(() => page.change({ size: (size * v) / now }, true));
});
$("exposure").addEventListener("input", (event) => {
  beforeExposure ??= history.now;
  showLit({ exposure_ev: event.target.valueAsNumber });
});
// No change is told of a slider that is dragged away and back.
for (const end of ["change", "pointerup", "pointercancel", "blur"]) {
  $("exposure").addEventListener(end, () => {
    if (!beforeExposure) return;
    history.commit(history.now, beforeExposure, "exposure");
    beforeExposure = null;
    refresh();
  });
}
$("copy").addEventListener("click", () => page.copy());
$("remove").addEventListener("click", () => page.remove());
$("undo").addEventListener("click", () => step("undo"));
$("redo").addEventListener("click", () => step("redo"));
$("save").addEventListener("click", save);
$("show").addEventListener("change", () => page.redraw());
$("direction").addEventListener("change", () => solve());
$("second").addEventListener("change", (event) => {
  tools.second = event.target.checked;
  [[tools.lines.chosen]] = tools.lines.lines;
  solve();
  page.redraw();
});
$("use-lines").addEventListener("click", () => solved && edit({ turn: solved.turn }, true));
$("use-measure").addEventListener("click", async () => {
  const [ends] = tools.measure.lines;
  const length_m = $("length").valueAsNumber;
  if (!(length_m > 0)) return say("Say how long it is: more than 0 m.", true);
  try {
    const body = { edit: history.now.edit, ends, length_m };
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
$("clear").addEventListener("click", () => {
  const mask = new Uint8ClampedArray(layer.width * layer.height);
  setMask(mask, () => edit({ mask: true }, true, undefined, mask));
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
  if (!act || event.target.typing && act !== save) return;
  event.preventDefault();
  if (act !== save || !event.repeat) act();
});
const fit = () => {
  picture.fit();
  page.redraw();
};
window.addEventListener("resize", fit);
new ResizeObserver(fit).observe($("canvas").parentElement); // a scroll bar takes its width
// Another tab may have saved the file.
window.addEventListener("focus", () => !saving && !dragged() && refresh());
window.addEventListener("contextmenu", (event) => event.target === picture.canvas && event.preventDefault());
window.addEventListener("beforeunload", (event) => history.past.length && event.preventDefault());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", showLight);

$("file").textContent = first.file;
$("help").textContent = HELP.move;
say("");
document.documentElement.dataset.ready = "yes";
refresh();
showNumbers(page.view, page.chosen);
