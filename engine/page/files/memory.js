// What a player should remember at this step: commands, the tiles of a path, or places; and how well the agent does.

import { $, make } from "./dom.js";
import { arrowOf, outcomeOf, unitOf } from "./tasks.js";

/** Columns of a long path that are shown. */
const COLUMNS = 16;

/** What an episode has shown, as an element; null if it has shown nothing. */
export function clueNode(state) {
  const { commands, walked, falls, coins, exit } = state.clues ?? {};
  if (commands?.length) return commandList(state);
  if (walked?.length) return path(walked, falls);
  if (coins?.length || exit) return places(coins, exit);
  return null;
}

/** The commands, each above what was carried out, with marks for the finished ones and the next or forgotten one. */
function commandList(state) {
  const { commands, carried_out: carried } = state.clues;
  const progress = state.progress.find(({ name, of }) => name === "commands" && of !== null)?.value ?? 0;
  const right = carried.findIndex((command, place) => command !== commands[place]);
  const done = Math.max(progress, right < 0 ? carried.length : right);
  const outcome = outcomeOf(state);
  const kind = (place) => {
    if (place < done) return "done";
    if (place > done || outcome === "success") return "later";
    return outcome ? "failed" : "next";
  };
  const items = commands.map((command, place) => {
    const className = kind(place);
    const went = className === "done" || carried[place] === command ? "" : carried[place] ?? "";
    const said = { done: "✓", failed: carried[place] ? "✕ went" : "✕ failed", next: "next", later: "" }[className];
    return make("li", { className },
      make("b", { ariaHidden: "true" }, arrowOf(command)),
      make("span", {}, command),
      make("small", {}, said),
      make("i", { ariaHidden: "true" }, went && (arrowOf(went) ?? "?")),
      make("span", { className: "visually-hidden" }, went),
    );
  });
  return make("ol", { className: "commands" }, ...items);
}

/** The tiles that were walked, and the falls beside them. */
function path(walked, falls) {
  const last = Math.max(6, ...[...walked, ...falls].map(([x]) => x));
  const first = Math.max(0, last - COLUMNS + 1);
  const shown = (tiles) => tiles.filter(([x]) => x >= first);
  return picture(`0 0 ${last - first + 1} 7`, `${walked.length} tiles of the path, and falls at ${falls.length} beside it`, [
    ...shown(walked).map(([x, y]) => ["rect", "tile", { x: x - first + 0.06, y: y + 0.06, width: 0.88, height: 0.88 }]),
    ...shown(falls).map(([x, y]) => ["path", "fall", { d: `M${x - first + 0.25} ${y + 0.25}l.5 .5m0-.5l-.5 .5` }]),
  ]);
}

/** The coins that were seen and not yet collected, and the exit. */
function places(coins, exit) {
  const said = [`${coins.length} coin${coins.length === 1 ? "" : "s"} seen`, exit ? "the exit seen" : ""].filter(Boolean).join(", ");
  return picture("0 0 1 1", said, [
    ...(exit ? [["rect", "exit", { x: exit[0] - 0.07, y: exit[1] - 0.07, width: 0.14, height: 0.14 }]] : []),
    ...coins.map(([cx, cy]) => ["circle", "coin", { cx, cy, r: 0.05 }]),
  ]);
}

function picture(viewBox, label, shapes) {
  const shape = (kind, attributes) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", kind);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    return made;
  };
  const svg = shape("svg", { viewBox, role: "img", "aria-label": label, class: "map" });
  svg.append(...shapes.map(([kind, name, attributes]) => shape(kind, { class: name, ...attributes })));
  return svg;
}

/** Shows what an episode that plays by itself, or that is over, has shown; and the agent's results. */
export function showMemory(state, agents, isPerson) {
  const node = isPerson && !state.done ? null : clueNode(state);
  $("clues").replaceChildren(...(node ? [node] : []));
  $("no-clues").hidden = Boolean(node);
  $("no-clues").textContent = isPerson ? "Shown at the end, or while an agent or the expert plays." : "Nothing was shown yet.";
  const { episodes, successes, score } = agents.counted(state);
  const result = outcomeOf({ ...state, done: true }) === "end" ? `Mean of ${episodes}: ${(score / episodes).toFixed(1)} ${unitOf(state)}.` : `Successes: ${successes} of ${episodes}.`;
  $("successes").textContent = episodes === 0 ? "" : result;
  $("trained").textContent = agents.description(state.id) ? agents.trained(state.id) : "";
}
