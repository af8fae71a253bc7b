// Shows what a player should remember at this step, and how often the agent succeeds.

import { arrowOf, outcomeOf } from "./tasks.js";

const $ = (id) => document.getElementById(id);

/** Lists the commands that an episode of an agent has shown, and marks the finished ones and the next one. */
export function showMemory(state, agents, isAgent) {
  const clues = isAgent ? state.clues : [];
  const done = state.progress.find(({ name }) => name === "commands")?.value ?? 0;
  const outcome = outcomeOf(state);
  const kind = (place) => {
    if (place < done) return "done";
    if (place > done || outcome === "success") return "later";
    return outcome === "failure" ? "failed" : "next";
  };
  const list = $("clues");
  list.replaceChildren(...clues.map((command, place) => {
    const item = document.createElement("li");
    item.className = kind(place);
    const said = { done: "✓", failed: "✕ failed", next: "next", later: "" }[item.className];
    item.append(
      Object.assign(document.createElement("b"), { textContent: arrowOf(command), ariaHidden: "true" }),
      ` ${command} `,
      Object.assign(document.createElement("span"), { textContent: said }),
    );
    return item;
  }));
  $("no-clues").hidden = clues.length > 0;
  $("no-clues").textContent = isAgent ? "Nothing was shown yet." : "Here appear the commands while the agent plays.";
  const { episodes, successes } = agents.counted(state);
  $("successes").textContent = episodes === 0 ? "" : `Successes: ${successes} of ${episodes}.`;
  $("trained").textContent = agents.description(state.id) ? agents.trained(state.id) : "";
}
