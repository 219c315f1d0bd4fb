// The fields beside the picture.

const $ = (id) => document.getElementById(id);

const ENDS = "Arrows move an end, Enter takes the next one.";

export const HELP = {
  move: "Drag the object over the ground. Wheel: size. Shift and wheel, or R and drag: turn. Arrows, Q, E, + and - do the same; C copies, Delete removes, [ and ] choose.",
  lines: `Drag the ends of the lines. ${ENDS}`,
  measure: `Drag both ends of the line onto the ground. ${ENDS}`,
  mask: "Paint over what stands in front of the object. Arrows move the brush; Enter puts it down and lifts it.",
  shadow: `Drag one end to the foot, the other to the tip of the shadow. ${ENDS}`,
};

export function say(text, bad = false) {
  $("status").textContent = text;
  $("status").classList.toggle("bad", bad);
}

// A number field that reports finite numbers when they are entered. What `change` answers with false, and what is no
// number, gives way to what was shown before.
export function number(id, change) {
  const field = $(id);
  const enter = () => {
    field.typing = false;
    const value = field.valueAsNumber;
    if (!Number.isFinite(value) || change(value) === false) field.value = field.shown;
  };
  field.addEventListener("input", () => (field.typing = true));
  field.addEventListener("change", enter);
  field.addEventListener("blur", () => field.typing && enter());
}

// Writes a value into a field that is not being typed in.
export function put(id, value, digits = 2) {
  const field = $(id);
  field.shown = Number.isFinite(value) ? String(Number(value.toFixed(digits))) : "";
  if (!field.typing) field.value = field.shown;
}

let listed = null;

// The list of objects. It is made anew only for other objects: a click or the keyboard may be at work in it.
export function objects(names, edit, chosen, choose) {
  let stays = false; // the keyboard in the list
  const said = edit.objects.map((object, k) => `${k + 1} ${names[object.of]}`);
  if (said.join("\n") !== listed) {
    listed = said.join("\n");
    const list = said.map((text, k) => {
      const label = document.createElement("label");
      const input = Object.assign(document.createElement("input"), { type: "radio", name: "object" });
      input.addEventListener("change", () => choose(k));
      label.append(input, text);
      return label;
    });
    stays = $("objects").contains(document.activeElement);
    $("objects").replaceChildren(...list);
  }
  const now = $("objects").querySelectorAll("input")[chosen];
  now.checked = true;
  if (stays) now.focus();
}

export function showNumbers(view, chosen) {
  const object = view.objects[chosen];
  const { pitch_deg, roll_deg, fov_deg, height_m } = view.camera;
  const shown = view.undistorted ? ", of the picture as it is shown: without the distortion of the lens" : "";
  const way = pitch_deg < 0 ? "down" : "up";
  $("camera").textContent =
    `${height_m.toFixed(2)} m above the ground, looks ${Math.abs(pitch_deg).toFixed(1)}° ${way}, ` +
    `roll ${roll_deg.toFixed(1)}°, field of view ${fov_deg.toFixed(1)}° (vertical)${shown}`;
  if (object) {
    const [width, height, depth] = object.size_m;
    put("yaw", object.yaw_deg, 1);
    put("height", height, 3);
    $("where").textContent =
      `${width.toFixed(2)} × ${height.toFixed(2)} × ${depth.toFixed(2)} m (width, height, depth), ` +
      `${object.distance_m.toFixed(1)} m from the camera`;
  }
  // What has been said already is not said again.
  const said = [...$("warnings").children].map((item) => item.textContent);
  if (said.join("\n") === view.warnings.join("\n")) return;
  const warnings = view.warnings.map((text) => Object.assign(document.createElement("li"), { textContent: text }));
  $("warnings").replaceChildren(...warnings);
}
