// The picture: photograph, draft, mask, and lines with a dark halo. Positions are pixels of the
// photograph.

const PENS = [
  ["255,255,255", 0.8, 0.5], // grid
  ["255,255,255", 1.3, 0.75], // every fifth line
  ["255,209,64", 1.4, 0.9], // horizon
  ["90,217,255", 1.3, 0.9], // box
  ["255,128,26", 2.2, 1], // front
  ["255,255,255", 1.6, 1], // stick
];

export class Picture {
  constructor(canvas, photo, { size, shown, border }) {
    Object.assign(this, { canvas, photo, size, shown, border });
    this.context = canvas.getContext("2d");
    this.fit();
  }

  // Fills the width, but no more than a part of the window's height.
  fit() {
    const parent = this.canvas.parentElement.clientWidth;
    const [w, h] = this.size;
    const tall = window.innerWidth <= 760 ? 0.5 : 0.74;
    const width = Math.max(120, Math.min(parent, (tall * window.innerHeight * w) / h));
    const ratio = window.devicePixelRatio || 1;
    this.canvas.style.width = `${width}px`;
    this.canvas.style.height = `${(width * h) / w}px`;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round((width * ratio * h) / w);
    this.scale = width / w; // CSS pixels of a pixel of the photograph
    this.zoom = this.canvas.width / w;
  }

  at(event) {
    const box = this.canvas.getBoundingClientRect();
    const [w, h] = this.size;
    return [((event.clientX - box.left) * w) / box.width, ((event.clientY - box.top) * h) / box.height];
  }

  lines(list, faded = 1) {
    const { context, zoom } = this;
    const ratio = window.devicePixelRatio || 1;
    for (const halo of [true, false]) {
      for (const [kind, x0, y0, x1, y1, opacity] of list) {
        const [color, width, strength] = PENS[kind];
        const alpha = opacity * strength * faded;
        context.strokeStyle = halo ? `rgba(0,0,0,${0.45 * alpha})` : `rgba(${color},${alpha})`;
        context.lineWidth = (width + (halo ? 2 : 0)) * ratio;
        context.beginPath();
        context.moveTo(x0 * zoom, y0 * zoom);
        context.lineTo(x1 * zoom, y1 * zoom);
        context.stroke();
      }
    }
  }

  line([a, b], color, width = 2) {
    const { context, zoom } = this;
    const ratio = window.devicePixelRatio || 1;
    for (const [style, wide] of [["rgba(0,0,0,.55)", width + 2], [color, width]]) {
      context.strokeStyle = style;
      context.lineWidth = wide * ratio;
      context.beginPath();
      context.moveTo(a[0] * zoom, a[1] * zoom);
      context.lineTo(b[0] * zoom, b[1] * zoom);
      context.stroke();
    }
  }

  // `radius` in pixels of the screen.
  handle([x, y], color, radius = 7) {
    const { context, zoom } = this;
    const ratio = window.devicePixelRatio || 1;
    context.beginPath();
    context.arc(x * zoom, y * zoom, radius * ratio, 0, 7);
    context.fillStyle = "rgba(0,0,0,.45)";
    context.fill();
    context.strokeStyle = color;
    context.lineWidth = 2 * ratio;
    context.stroke();
  }

  text([x, y], text) {
    const { context, zoom } = this;
    const ratio = window.devicePixelRatio || 1;
    context.font = `${12 * ratio}px system-ui, sans-serif`;
    context.textAlign = "center";
    context.lineWidth = 3 * ratio;
    context.strokeStyle = "rgba(0,0,0,.6)";
    context.strokeText(text, x * zoom, y * zoom);
    context.fillStyle = "#fff";
    context.fillText(text, x * zoom, y * zoom);
  }

  // Darkens what the photograph does not show.
  dim() {
    const { context, canvas, zoom, border } = this;
    context.beginPath();
    context.rect(0, 0, canvas.width, canvas.height);
    border.forEach(([x, y], k) => context[k ? "lineTo" : "moveTo"](x * zoom, y * zoom));
    context.closePath();
    context.fillStyle = "rgba(0,0,0,.6)";
    context.fill("evenodd");
  }

  draw(view, { draft, grid, mask, chosen, showGrid, tool }) {
    const { context, canvas } = this;
    context.drawImage(this.photo, 0, 0, canvas.width, canvas.height);
    const part = canvas.width / this.shown[0];
    if (draft) {
      const [x0, y0, x1, y1] = draft.place;
      context.drawImage(draft.image, x0 * part, y0 * part, (x1 - x0) * part, (y1 - y0) * part);
    }
    if (this.border.length) this.dim();
    if (mask && tool === "mask") {
      context.globalAlpha = 0.5;
      context.drawImage(mask, 0, 0, canvas.width, canvas.height);
      context.globalAlpha = 1;
    }
    if (showGrid) {
      this.lines(grid);
      this.lines(view.horizon);
      this.lines(view.stick);
    }
    if (tool !== "mask") view.objects.forEach((object, k) => this.lines(object.lines, k === chosen ? 1 : 0.45));
    if (showGrid && view.stick_label) this.text(view.stick_label.at, view.stick_label.text);
  }
}
