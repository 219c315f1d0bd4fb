// The sun on a disc seen from above: the middle is overhead, the rim the horizon, ahead is up.

export class Dial {
  // `change(sun, done, kind)` is told of {azimuth_deg, elevation_deg}.
  constructor(canvas, change) {
    this.canvas = canvas;
    this.change = change;
    this.sun = null;
    let held = null; // the pointer that drags
    const move = (event, done) => {
      const box = canvas.getBoundingClientRect();
      const half = box.width / 2;
      const x = (event.clientX - box.left - half) / (half - 10);
      const y = (event.clientY - box.top - half) / (half - 10);
      const azimuth_deg = (Math.atan2(x, -y) * 180) / Math.PI;
      const elevation_deg = 90 * (1 - Math.min(1, Math.hypot(x, y)));
      change({ azimuth_deg, elevation_deg }, done);
    };
    canvas.addEventListener("pointerdown", (event) => {
      if (held !== null) return;
      held = event.pointerId;
      canvas.setPointerCapture(event.pointerId);
      move(event, false);
    });
    canvas.addEventListener("pointermove", (event) => held === event.pointerId && move(event, false));
    canvas.addEventListener("pointerup", (event) => {
      if (held !== event.pointerId) return;
      held = null;
      move(event, true);
    });
    // The system took the pointer away: the sun stays where it was shown last.
    canvas.addEventListener("pointercancel", (event) => {
      if (held !== event.pointerId) return;
      held = null;
      if (this.sun) change(this.sun, true);
    });
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-5, 0], ArrowRight: [5, 0], ArrowUp: [0, 5], ArrowDown: [0, -5] }[event.key];
      if (!step) return;
      event.preventDefault();
      const sun = this.sun ?? { azimuth_deg: 0, elevation_deg: 45 };
      const azimuth = ((sun.azimuth_deg + step[0] + 540) % 360) - 180;
      const elevation = Math.max(0, Math.min(90, sun.elevation_deg + step[1]));
      change({ azimuth_deg: azimuth, elevation_deg: elevation }, true, "sun");
    });
  }

  // Draws the sun; one that is only estimated is hollow.
  draw(sun, said) {
    this.sun = sun;
    const ratio = window.devicePixelRatio || 1;
    const side = 132;
    this.canvas.style.width = this.canvas.style.height = `${side}px`;
    this.canvas.width = this.canvas.height = side * ratio;
    const context = this.canvas.getContext("2d");
    context.scale(ratio, ratio);
    const style = getComputedStyle(document.documentElement);
    const half = side / 2;
    const rim = half - 10;
    context.strokeStyle = style.getPropertyValue("--line");
    for (const share of [1, 2 / 3, 1 / 3]) {
      context.beginPath();
      context.arc(half, half, rim * share, 0, 7);
      context.stroke();
    }
    context.fillStyle = style.getPropertyValue("--soft");
    context.beginPath();
    context.moveTo(half, 1);
    context.lineTo(half - 5, 9);
    context.lineTo(half + 5, 9);
    context.fill();
    if (!sun) return;
    const angle = (sun.azimuth_deg * Math.PI) / 180;
    const radius = rim * (1 - Math.max(0, sun.elevation_deg) / 90);
    context.beginPath();
    context.arc(half + radius * Math.sin(angle), half - radius * Math.cos(angle), 7, 0, 7);
    context.lineWidth = 2.5;
    context.strokeStyle = style.getPropertyValue("--sun");
    context.fillStyle = "#ffc93c";
    if (said) context.fill();
    context.stroke();
  }
}
