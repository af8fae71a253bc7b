// A clock that requests steps at a pace, once per animation frame.

/** Maximum number of steps per animation frame; steps beyond it are dropped. */
const MOST = 200;

/** Milliseconds that a frame makes up for at most, so that no step is missed while the page was hidden or busy. */
const LONGEST = 100;

export class Pace {
  #last = null;
  #due = 0;
  #running = false;

  /** Calls `steps(count)` while it runs. */
  constructor(stepsPerSecond, steps) {
    this.stepsPerSecond = stepsPerSecond;
    this.steps = steps;
  }

  get running() {
    return this.#running;
  }

  start() {
    if (this.#running) return;
    this.#running = true;
    this.#last = null;
    // The first step does not wait.
    this.#due = 1;
    requestAnimationFrame((now) => this.#frame(now));
  }

  stop() {
    this.#running = false;
  }

  #frame(now) {
    if (!this.#running) return;
    if (this.#last !== null) this.#due += (Math.min(now - this.#last, LONGEST) / 1000) * this.stepsPerSecond;
    this.#last = now;
    const count = Math.min(Math.floor(this.#due), MOST);
    this.#due = Math.min(this.#due - count, 1);
    if (count > 0) this.steps(count);
    requestAnimationFrame((next) => this.#frame(next));
  }
}
