// Live regions, whose changes a screen reader speaks.

/** Least milliseconds between two changes of one. */
const INTERVAL = 1000;

/** A function that sets the text of an element at most once a second; of several texts in between, the last counts. */
export function live(element) {
  let [last, timer, next] = [-Infinity, null, ""];
  return (text) => {
    next = text;
    timer ??= setTimeout(() => {
      timer = null;
      if (element.textContent === next) return;
      [element.textContent, last] = [next, performance.now()];
    }, Math.max(0, last + INTERVAL - performance.now()));
  };
}
