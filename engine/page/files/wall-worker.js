// The worker of the wall: its environments, which plan, step and draw without holding up the page.

import { Engine } from "./engine.js";
import { Pace } from "./pace.js";

/** Milliseconds per frame that steps may take. */
const BUDGET = 10;

/** Milliseconds between two reports. */
const INTERVAL = 500;

let [engine, canvas, state, since] = [null, null, null, null];

const pace = new Pace(25, (count) => {
  try {
    const start = performance.now();
    let step = 0;
    do state = engine.stepWall(1);
    while (++step < count && performance.now() - start < BUDGET);
    since.steps += step;
    since.pictures += 1;
    draw();
  } catch (error) {
    return fail(error);
  }
  const seconds = (performance.now() - since.time) / 1000;
  // The first steps, in which experts plan, tell nothing about the rest.
  if (seconds * 1000 >= INTERVAL) report(since.isFirst ? null : since.steps / seconds, since.pictures / seconds);
});

function draw() {
  canvas.getContext("2d").putImageData(engine.wall(state.width, state.height), 0, 0);
}

/** Tells the page the state, and how often a second each environment stepped and the wall was drawn. */
function report(rate, pictures, isFirst = false) {
  since = { time: performance.now(), steps: 0, pictures: 0, isFirst };
  postMessage({ state, rate, pictures });
}

function fail(error) {
  pace.stop();
  postMessage({ error: error.message });
}

const TASKS = {
  async open({ module, surface }) {
    [engine, canvas] = [await Engine.of(module), surface];
  },
  start({ request }) {
    state = engine.request({ wall: request });
    Object.assign(canvas, { width: state.width, height: state.height });
    draw();
    report(null, null, true);
    pace.start();
  },
  run({ running }) {
    since = { time: performance.now(), steps: 0, pictures: 0, isFirst: true };
    if (running) pace.start();
    else pace.stop();
  },
  pace({ stepsPerSecond }) {
    pace.stepsPerSecond = stepsPerSecond;
  },
  tile({ place }) {
    postMessage({ tile: engine.request({ tile: { place } }) });
  },
};

// One task after the other, since the first one waits for the engine.
let before = Promise.resolve();
addEventListener("message", ({ data }) => {
  before = before.then(() => TASKS[data.task](data)).catch(fail);
});
