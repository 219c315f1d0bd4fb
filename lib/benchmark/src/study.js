"use strict";
// Pairs, pictures and the seed are in the page; nothing leaves it but the file that is saved.
const at = (id) => document.getElementById(id);
const data = JSON.parse(at("data").textContent);
let who = "", seed = 0, order = [], choices = [];
// A hash of the participant's name, so that everybody gets an order of their own and the same one again.
function hashed(text) {
  let h = 2166136261;
  for (const c of text) { h = Math.imul(h ^ c.codePointAt(0), 16777619); }
  return h >>> 0;
}
function random(state) {
  return () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let t = Math.imul(state ^ (state >>> 15), 1 | state);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}
function shuffled(pairs, next) {
  const list = pairs.map((p) => next() < 0.5 ? p : { scene: p.scene, left: p.right, right: p.left });
  for (let k = list.length - 1; k > 0; k--) {
    const j = Math.floor(next() * (k + 1));
    [list[k], list[j]] = [list[j], list[k]];
  }
  return list;
}
function key() { return "dipir-study-" + data.seed + "-" + who; }
// What a browser does not keep is still on the page.
function keep() {
  try { localStorage.setItem(key(), JSON.stringify(choices)); } catch { }
}
// The choices of an earlier visit, as far as they are about the pairs of this page.
function kept() {
  let found = [];
  try { found = JSON.parse(localStorage.getItem(key()) || "[]"); } catch { }
  const sides = (a, b) => [a, b].sort().join("\n");
  const fits = (choice, k) => k < order.length && choice.scene === order[k].scene
    && sides(choice.preferred, choice.over) === sides(order[k].left, order[k].right);
  const other = found.findIndex((choice, k) => !fits(choice, k));
  return other < 0 ? found : found.slice(0, other);
}
function show() {
  const done = choices.length >= order.length;
  at("pairs").classList.toggle("hidden", done);
  at("end").classList.toggle("hidden", !done);
  at("count").textContent = Math.min(choices.length + 1, order.length) + " of " + order.length;
  if (done) { return; }
  const pair = order[choices.length];
  at("left").src = data.pictures[pair.scene][pair.left];
  at("right").src = data.pictures[pair.scene][pair.right];
}
function choose(side) {
  const pair = order[choices.length];
  if (!pair) { return; }
  const [preferred, over] = side === "left" ? [pair.left, pair.right] : [pair.right, pair.left];
  choices.push({ scene: pair.scene, preferred, over });
  keep();
  show();
}
function start(event) {
  event.preventDefault();
  who = at("who").value.trim();
  if (!who) { return; }
  seed = (data.seed + hashed(who)) % 4294967296;
  order = shuffled(data.pairs, random(seed));
  choices = kept();
  at("start").classList.add("hidden");
  at("task").classList.remove("hidden");
  show();
}
function save() {
  const text = JSON.stringify({ participant: who, seed, choices }, null, 2);
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
  link.download = "answers-" + who.replace(/[^A-Za-z0-9_-]/g, "-") + ".json";
  link.click();
  URL.revokeObjectURL(link.href);
}
at("start").addEventListener("submit", start);
at("choose-left").addEventListener("click", () => choose("left"));
at("choose-right").addEventListener("click", () => choose("right"));
at("back").addEventListener("click", () => { choices.pop(); keep(); show(); });
for (const button of document.querySelectorAll(".save")) { button.addEventListener("click", save); }
document.addEventListener("keydown", (event) => {
  if (!order.length || event.target.tagName === "INPUT") { return; }
  if (event.key === "ArrowLeft") { choose("left"); }
  if (event.key === "ArrowRight") { choose("right"); }
});
