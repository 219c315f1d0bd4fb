// What was changed, with undo. A state is never altered, only replaced.

export class History {
  constructor(start) {
    this.reset(start);
  }

  reset(start) {
    this.past = [];
    this.future = [];
    this.now = start;
    this.kind = null;
  }

  // Replaces the state for the time of a drag.
  show(state) {
    this.now = state;
  }

  // Replaces the state for good; `before` is where undo leads. What is of one `kind` and comes within a second of the
  // last one, such as turns of the wheel, is undone with it.
  commit(state, before = this.now, kind = null) {
    if (JSON.stringify(state.edit) === JSON.stringify(before.edit) && state.mask === before.mask) {
      this.now = state;
      return;
    }
    const time = performance.now();
    const goesOn = kind !== null && kind === this.kind && time - this.time < 1000;
    if (!goesOn) this.past.push(before);
    this.future = [];
    this.now = state;
    [this.kind, this.time] = [kind, time];
  }

  // Takes the last change back for good; whether there was one.
  drop() {
    if (!this.past.length) return false;
    this.kind = null;
    this.now = this.past.pop();
    return true;
  }

  undo() {
    if (!this.past.length) return false;
    this.kind = null;
    this.future.push(this.now);
    this.now = this.past.pop();
    return true;
  }

  redo() {
    if (!this.future.length) return false;
    this.kind = null;
    this.past.push(this.now);
    this.now = this.future.pop();
    return true;
  }
}
