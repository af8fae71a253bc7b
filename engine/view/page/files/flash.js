// A short flash of the picture's border, with a sign, for rewards and for the end of an episode.

const SIGNS = { reward: "+", damage: "−", success: "✓", failure: "✕" };

/** How long the sign stays in milliseconds; the style sheet's animation lasts as long. */
const MILLISECONDS = 450;

let timer = null;

/** Flashes on `screen`, an element with a place for the sign. `kind` is a key of SIGNS. */
export function flash(screen, kind) {
  const sign = screen.querySelector(".sign");
  clearTimeout(timer);
  delete screen.dataset.flash;
  // Reading a size makes the browser take note of the removal, so that the animation starts again.
  void screen.offsetWidth;
  screen.dataset.flash = kind;
  sign.textContent = SIGNS[kind];
  timer = setTimeout(() => {
    delete screen.dataset.flash;
    sign.textContent = "";
  }, MILLISECONDS);
}
