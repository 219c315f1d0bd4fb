// What the pointer and the keys do on the picture, tool by tool.
import { say } from "./panel.js";

const BLUE = "#5ab4ff";
const GREEN = "#61d095";
const YELLOW = "#ffd140";

const within = (at, size) => at.map((x, k) => Math.max(0, Math.min(size[k], x)));

// A list of lines whose ends are dragged.
class Ends {
  constructor(lines, colors) {
    Object.assign(this, { lines, colors, held: null });
    this.chosen = lines[0][0]; // the end that the keys move
  }

  draw(picture, keyed, count = this.lines.length) {
    this.lines.slice(0, count).forEach((line, k) => {
      picture.line(line, this.colors[k]);
      line.forEach((end) => picture.handle(end, this.colors[k], keyed && end === this.chosen ? 12 : 7));
    });
  }

  next(count = this.lines.length) {
    const ends = this.lines.slice(0, count).flat();
    this.chosen = ends[(ends.indexOf(this.chosen) + 1) % ends.length];
  }

  // The end near a place, within 22 pixels of the screen.
  grab([x, y], reach, count = this.lines.length) {
    let best = reach;
    this.held = null;
    this.lines.slice(0, count).forEach((line) =>
      line.forEach((end) => {
        const far = Math.hypot(end[0] - x, end[1] - y);
        if (far < best) {
          best = far;
          this.held = end;
        }
      }),
    );
    this.chosen = this.held ?? this.chosen;
    return this.held !== null;
  }

  // Ends stay in the picture, where they can be taken again.
  move(end, at, size) {
    within(at, size).forEach((x, k) => (end[k] = x));
  }
}

export class Tools {
  // `page` offers: picture, history, view, chosen, choose, pose, change, finish, copy, remove, redraw, linesChanged, paint, brush.
  constructor(page, size) {
    this.page = page;
    this.name = "move";
    const [w, h] = size;
    const of = (...p) => p.map(([x, y]) => [x * w, y * h]);
    this.lines = new Ends(
      [of([0.2, 0.95], [0.42, 0.6]), of([0.8, 0.95], [0.58, 0.6]), of([0.1, 0.72], [0.9, 0.7]), of([0.1, 0.85], [0.9, 0.86])],
      [BLUE, BLUE, GREEN, GREEN],
    );
    this.measure = new Ends([of([0.4, 0.8], [0.6, 0.8])], [YELLOW]);
    this.shadow = new Ends([of([0.4, 0.8], [0.55, 0.75])], [YELLOW]);
    this.second = false;
    this.brush = [w / 2, h / 2]; // where the keys paint
    this.isDown = false; // whether they do
    this.keys = new Set();
    this.pointers = new Map();
    const canvas = page.picture.canvas;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.moved(event));
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => this.up(event));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("focus", () => page.redraw());
    canvas.addEventListener("blur", () => {
      this.lift();
      page.redraw();
    });
    window.addEventListener("keydown", (event) => this.keys.add(event.key.toLowerCase()));
    window.addEventListener("keyup", (event) => this.keys.delete(event.key.toLowerCase()));
    window.addEventListener("blur", () => this.keys.clear());
  }

  get ends() {
    return { lines: this.lines, measure: this.measure, shadow: this.shadow }[this.name];
  }

  get count() {
    return this.name === "lines" && !this.second ? 2 : undefined;
  }

  draw() {
    const { picture, view, chosen } = this.page;
    const keyed = picture.canvas.matches(":focus-visible");
    this.ends?.draw(picture, keyed, this.count);
    if (this.name === "mask" && keyed) picture.handle(this.brush, this.isDown ? "#ff2f6d" : "#fff", this.page.brush() / 2);
    const contact = view.objects[chosen]?.contact;
    if (this.name === "move" && contact) picture.handle(contact, "#ff801a", 9);
  }

  down(event) {
    const { page } = this;
    page.picture.canvas.focus({ preventScroll: true });
    page.picture.canvas.setPointerCapture(event.pointerId);
    const at = page.picture.at(event);
    this.pointers.set(event.pointerId, at);
    // A further finger takes part in what the first one began: it sizes, or paints.
    if (this.pointers.size > 1) return;
    this.first = event.pointerId;
    this.before = page.history.now;
    if (this.name === "mask") return page.paint(at, at, false);
    if (this.ends) {
      this.ends.grab(at, 22 / page.picture.scale, this.count);
      return;
    }
    this.pick(at);
    const { contact, yaw } = page.pose();
    this.start = { at, contact: contact ?? at, yaw: yaw ?? 0 };
    this.turns = this.keys.has("r") || event.altKey || event.button === 2;
  }

  // Chooses the object whose box is at the place.
  pick([x, y]) {
    const { page } = this;
    const holds = (object) => {
      const xs = object.lines.flatMap((l) => [l[1], l[3]]);
      const ys = object.lines.flatMap((l) => [l[2], l[4]]);
      return x >= Math.min(...xs) && x <= Math.max(...xs) && y >= Math.min(...ys) && y <= Math.max(...ys);
    };
    if (page.view.objects[page.chosen] && holds(page.view.objects[page.chosen])) return;
    const found = page.view.objects.findIndex(holds);
    if (found >= 0) page.choose(found);
  }

  moved(event) {
    const { page } = this;
    if (!this.pointers.has(event.pointerId)) return;
    const at = page.picture.at(event);
    const last = this.pointers.get(event.pointerId);
    if (this.pointers.size === 2 && this.name === "move") {
      this.pinch(event.pointerId, at);
      return;
    }
    this.pointers.set(event.pointerId, at);
    if (this.name === "mask") return page.paint(last, at, false);
    if (event.pointerId !== this.first) return;
    if (this.ends) {
      if (this.ends.held) this.ends.move(this.ends.held, at, page.picture.size);
      page.linesChanged();
      return page.redraw();
    }
    if (!this.start) return;
    const [dx, dy] = [at[0] - this.start.at[0], at[1] - this.start.at[1]];
    if (this.turns) return page.change({ yaw_deg: this.start.yaw + 0.5 * dx * page.picture.scale }, false);
    page.change({ at: [this.start.contact[0] + dx, this.start.contact[1] + dy] }, false);
  }

  // Two fingers size the object.
  pinch(id, at) {
    const other = [...this.pointers].find(([k]) => k !== id)[1];
    const before = this.pointers.get(id);
    const far = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
    const factor = far(at) / Math.max(1, far(before));
    this.pointers.set(id, at);
    const size = this.page.history.now.edit.objects[this.page.chosen]?.size ?? 1;
    this.page.change({ size: size * factor }, false);
    this.start = null;
  }

  up(event) {
    const { page } = this;
    if (!this.pointers.delete(event.pointerId) || this.pointers.size) return;
    if (this.name === "mask") return page.paint(null, null, true);
    if (this.ends) return;
    this.start = null;
    page.finish(this.before);
  }

  wheel(event) {
    if (this.name !== "move") return;
    event.preventDefault();
    // A notch of a wheel is about 100 pixels or 3 lines; touchpads report small parts of it, and two fingers that are
    // spread report the logarithm of the factor, in percent: 1.04 ** 25 = e.
    const unit = event.deltaMode === 1 ? 3 : event.ctrlKey ? 4 : 100;
    const step = Math.max(-1, Math.min(1, (event.deltaY || event.deltaX) / unit));
    event.shiftKey ? this.turn(5 * step) : this.size(1.04 ** -step);
  }

  // What is turned or sized in the midst of a drag is undone with it.
  turn(degrees) {
    const { yaw } = this.page.pose();
    if (yaw !== undefined) this.page.change({ yaw_deg: yaw + degrees }, !this.pointers.size, "turn");
  }

  size(factor) {
    const object = this.page.history.now.edit.objects[this.page.chosen];
    if (object) this.page.change({ size: (object.size ?? 1) * factor }, !this.pointers.size, "size");
  }

  // Ends a stroke that the keys began.
  lift() {
    if (!this.isDown) return;
    this.isDown = false;
    this.page.paint(null, null, true);
  }

  // Keys of the tools with ends, and of the brush; whether the key was one.
  keyOfTool(key, by) {
    const { page, ends, brush } = this;
    if (by) {
      const at = within((ends?.chosen ?? brush).map((x, k) => x + by[k]), page.picture.size);
      if (ends) ends.move(ends.chosen, at, page.picture.size);
      else if (this.isDown) page.paint(brush, at, false);
      if (!ends) this.brush = at;
      page.linesChanged();
    } else if (key !== "Enter" && key !== " ") {
      return false;
    } else if (ends) {
      ends.next(this.count);
    } else if (this.isDown) {
      this.lift();
      say("The brush is lifted.");
    } else {
      this.isDown = true;
      page.paint(brush, brush, false);
      say("The brush is down.");
    }
    page.redraw();
    return true;
  }

  key(event) {
    // Some keyboards have brackets on a second level, which systems report as Ctrl and Alt.
    if ((event.ctrlKey && !event.getModifierState("AltGraph")) || event.metaKey) return;
    const { page } = this;
    const step = (event.shiftKey ? 10 : 2) / page.picture.scale;
    const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (this.name !== "move") {
      if (this.pointers.size) return;
      if (this.keyOfTool(event.key, move?.map((x) => x * step))) event.preventDefault();
      return;
    }
    const { contact } = page.pose();
    const other = {
      q: () => this.turn(5), Q: () => this.turn(1), e: () => this.turn(-5), E: () => this.turn(-1),
      "+": () => this.size(1.04), "=": () => this.size(1.04), "-": () => this.size(1 / 1.04),
      "]": () => page.choose(page.chosen + 1), "[": () => page.choose(page.chosen - 1),
      Delete: () => event.repeat || page.remove(), c: () => event.repeat || page.copy(),
    }[event.key];
    if (this.pointers.size) return;
    if (move && contact) page.change({ at: contact.map((x, k) => x + move[k] * step) }, true, "move");
    else if (other) other();
    else return;
    event.preventDefault();
  }
}
