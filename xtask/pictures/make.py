"""Makes the pictures of the documentation in `docs/images`, and that of the learning curves: `cargo xtask pictures` installs the
packages and runs this script.

The animations are episodes of the scripted experts with fixed seeds. The charts show `benches/comparison.md` and the results of
`agents/benches/hour.py`; measure or train again to change them. The same versions give the same bytes.
"""

from pathlib import Path

import charts
import films

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs/images"
HOUR = ROOT / "agents/benches/hour"


def main() -> None:
    """Make all pictures."""
    (IMAGES / "environments").mkdir(parents=True, exist_ok=True)
    charts.comparison(IMAGES, ROOT / "benches/comparison.md")
    charts.hour(HOUR)
    films.overview(IMAGES / "environments.webp")
    for scene in films.SCENES:
        films.environment(IMAGES / "environments" / f"{scene.id}.webp", scene)
    for file in sorted(IMAGES.rglob("*.*")):
        print(f"{file.relative_to(ROOT)}: {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
