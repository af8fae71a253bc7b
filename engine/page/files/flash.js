// Flashes the picture's border with a sign, for rewards and for the end of an episode.

const SIGNS = { reward: "+", damage: "−", success: "✓", failure: "✕" };

/** How long the sign is shown in milliseconds, the same as the style sheet's animation. */
const MILLISECONDS = 450;

let timer = null;

/** Flashes on `screen`, an element that contains a `.sign`. `kind` is a key of SIGNS. */
export function flash(screen, kind) {
  const sign = screen.querySelector(".sign");
  clearTimeout(timer);
  delete screen.dataset.flash;
  // Reading a size forces a reflow, which restarts the animation.
  void screen.offsetWidth;
  screen.dataset.flash = kind;
  sign.textContent = SIGNS[kind];
  timer = setTimeout(() => {
    delete screen.dataset.flash;
    sign.textContent = "";
  }, MILLISECONDS);
}
