// What was changed, with undo. A state is never altered, only replaced.

export class History {
  constructor(start) {
    this.reset(start);
  }

  reset(start) {
    this.past = [];
    this.future = [];
    this.now = start;
  }

  // Replaces the state for the time of a drag.
  show(state) {
    this.now = state;
  }

  // Replaces the state for good; `before` is where undo leads.
  commit(state, before = this.now) {
    if (JSON.stringify(state.edit) === JSON.stringify(before.edit) && state.mask === before.mask) {
      this.now = state;
      return;
    }
    this.past.push(before);
    this.future = [];
    this.now = state;
  }

  undo() {
    if (!this.past.length) return false;
    this.future.push(this.now);
    this.now = this.past.pop();
    return true;
  }

  redo() {
    if (!this.future.length) return false;
    this.past.push(this.now);
    this.now = this.future.pop();
    return true;
  }
}
