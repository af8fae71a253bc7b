// Lets the page's agents play an episode as fast as they can, and tells how far each came.

import { Engine } from "./engine.js";

/** Steps after which an agent is not followed further, and steps of a request. */
const MOST = 40_000;
const PART = 1000;

/** The last task; an earlier one ends, since its episode is no longer shown. */
let last = null;

addEventListener("message", async ({ data }) => {
  last = data;
  const { asked, module, files, episode } = data;
  for (const file of files) {
    const [engine, response] = await Promise.all([Engine.of(module), fetch(new URL(`${file}.safetensors`, import.meta.url))]);
    if (!response.ok) continue;
    const { title } = engine.loadAgent(new Uint8Array(await response.arrayBuffer()));
    let state = engine.request({ start: episode });
    while (!state.done && state.length < MOST) {
      if (last !== data) return;
      state = engine.request({ steps_of_agent: { most: PART } });
      // Lets the next task arrive.
      await new Promise((done) => setTimeout(done));
    }
    if (last === data) postMessage({ asked, state, name: title.replace(/^An? (agent )?/, ""), isOver: state.done });
  }
});
