// Directions from the keyboard and from the pad on the screen.

const KEYS = {
  ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down",
  KeyA: "left", KeyD: "right", KeyW: "up", KeyS: "down",
};

/** Fields for text, and controls that the keyboard has reached and whose value the arrows change. */
const TYPING = "input:not([type=checkbox], [type=range]), textarea, :is(select, [type=range]):focus-visible";

/** Whether a control of the page receives the keys; otherwise, they belong to the game. */
export function isTyping(target) {
  return target instanceof Element && target.matches(TYPING);
}

/** The held directions, and those pressed since the last step, so that none is lost at a slow pace. */
export class Directions {
  #held = new Map();
  #pressed = new Set();

  /** Calls `pressed` whenever a direction is pressed. */
  constructor(pressed) {
    this.pressed = pressed;
    addEventListener("keydown", (event) => {
      const direction = KEYS[event.code];
      if (!direction || isTyping(event.target) || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      if (!event.repeat) this.press(event.code, [direction]);
    });
    addEventListener("keyup", (event) => this.release(event.code));
    addEventListener("blur", () => this.#held.clear());
  }

  press(source, directions) {
    this.#held.set(source, directions);
    directions.forEach((direction) => this.#pressed.add(direction));
    this.pressed();
  }

  release(source) {
    this.#held.delete(source);
  }

  /** The directions of the next step. */
  take() {
    const directions = [...this.#pressed, ...[...this.#held.values()].flat()];
    this.#pressed.clear();
    return directions;
  }

  clear() {
    this.#held.clear();
    this.#pressed.clear();
  }

  /** Attaches a pad of buttons with directions in `data-directions`. A finger may slide from one to another. */
  attach(pad) {
    const at = (event) => {
      const button = document.elementFromPoint(event.clientX, event.clientY)?.closest("[data-directions]");
      return button && pad.contains(button) ? button : null;
    };
    const show = (source, button) => {
      for (const other of pad.querySelectorAll(`[data-source="${source}"]`)) delete other.dataset.source;
      if (button) button.dataset.source = source;
    };
    const move = (event) => {
      const source = `pointer${event.pointerId}`;
      const button = at(event);
      if (button?.dataset.source === source) return;
      show(source, button);
      if (button) this.press(source, button.dataset.directions.split(" "));
      else this.release(source);
    };
    const end = (event) => {
      show(`pointer${event.pointerId}`, null);
      this.release(`pointer${event.pointerId}`);
    };
    pad.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      pad.setPointerCapture(event.pointerId);
      move(event);
    });
    pad.addEventListener("pointermove", (event) => {
      if (pad.hasPointerCapture(event.pointerId)) move(event);
    });
    pad.addEventListener("pointerup", end);
    pad.addEventListener("pointercancel", end);
  }
}
