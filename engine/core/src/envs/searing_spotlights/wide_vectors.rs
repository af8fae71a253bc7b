//! Repainting for processors with wider vectors, chosen at run time.
//!
//! A function is compiled for the features of the one that it is inlined into, so what repainting calls is `#[inline(always)]`.

use super::pictures::Assets;
use super::scene::Scene;
use crate::raster::Canvas;

/// [`Scene::repaint`] for this processor.
#[inline]
pub(super) fn repaint(assets: &Assets, shown: &Scene, scene: &Scene, canvas: &mut Canvas<'_>) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("bmi1") && is_x86_feature_detected!("bmi2") {
        // SAFETY: the processor has the features.
        #[expect(unsafe_code)]
        return unsafe { repaint_avx2(assets, shown, scene, canvas) };
    }
    scene.repaint(shown, assets, canvas);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,bmi1,bmi2")]
fn repaint_avx2(assets: &Assets, shown: &Scene, scene: &Scene, canvas: &mut Canvas<'_>) {
    scene.repaint(shown, assets, canvas);
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::envs::searing_spotlights::{SPECS, SearingSpotlights};
    use crate::envs::{Environment, FRAME_BYTES, Family, ResetParameters, SCREEN};
    use crate::random::Generator;

    /// Without AVX2, both are the baseline.
    #[test]
    fn the_baseline_paints_the_same_pixels() {
        for spec in SPECS {
            let Family::SearingSpotlights(variant) = spec.family else { panic!("{}", spec.id) };
            let parameters = ResetParameters::new(spec.id, spec.parameters, &Default::default()).unwrap();
            let assets = Arc::new(SearingSpotlights::assets(variant, &parameters));
            let (mut env, mut random) = (SearingSpotlights::new(&assets), Generator::from_seed(7));
            env.reset(&assets, &mut random);
            let mut shown = env.scene();
            let mut frames = [[0; FRAME_BYTES]; 2];
            for frame in &mut frames {
                SearingSpotlights::paint(&assets, &shown, &mut Canvas::new(frame, SCREEN, SCREEN));
            }
            for _ in 0..400 {
                let action = [random.integers(0, 3) as i32, random.integers(0, 3) as i32];
                if env.step(&action, &mut random).terminated {
                    env.reset(&assets, &mut random);
                }
                let scene = env.scene();
                let [chosen, baseline] = &mut frames;
                repaint(&assets, &shown, &scene, &mut Canvas::new(chosen, SCREEN, SCREEN));
                scene.repaint(&shown, &assets, &mut Canvas::new(baseline, SCREEN, SCREEN));
                assert!(chosen == baseline, "{}: {shown:?} to {scene:?}", spec.id);
                shown = scene;
            }
        }
    }
}
