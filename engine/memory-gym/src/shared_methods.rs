//! What the families implement of `Environment` in the same way.

/// The types and methods of `Environment` that only name or call the family's own: its `Assets` with a `config`, its `State`, its `Scene`.
/// With the argument, also those that are the same in families whose environments consist of `assets` and `state` only.
macro_rules! shared_methods {
    () => {
        type Variant = Variant;
        type Assets = Assets;
        type State = State;
        type Scene = Scene;

        fn assets(variant: Variant, parameters: &endless_gym_core::envs::ResetParameters) -> Assets {
            Assets::new(variant, Parameters::new(variant, parameters))
        }

        fn step(&mut self, action: &[i32], random: &mut Generator) -> endless_gym_core::envs::Transition {
            self.state.step(&self.assets.config, action, random)
        }

        fn shared(&self) -> &Arc<Assets> {
            &self.assets
        }

        fn paint(assets: &Assets, scene: &Scene, canvas: &mut Canvas<'_>) {
            scene.paint(assets, canvas);
        }

        fn features(&self, out: &mut [f32]) {
            self.state.write_features(&self.assets.config, out);
        }

        fn state(&self) -> &State {
            &self.state
        }

        fn progress(&self) -> Vec<endless_gym_core::envs::Progress> {
            self.state.progress(&self.assets.config)
        }
    };
    (all_of_assets_and_state) => {
        shared_methods!();

        fn reset(&mut self, assets: &Arc<Assets>, random: &mut Generator) {
            if !Arc::ptr_eq(&self.assets, assets) {
                self.assets = Arc::clone(assets);
            }
            self.state.reset(&assets.config, random);
        }

        fn draw_ground_truth(&mut self, canvas: &mut Canvas<'_>) {
            self.assets.draw_ground_truth(&self.state, canvas);
        }

        fn restore(&mut self, assets: &Arc<Assets>, state: State) -> Result<(), endless_gym_core::envs::InvalidState> {
            if !state.is_valid(&assets.config) {
                return Err(endless_gym_core::envs::InvalidState);
            }
            self.assets = Arc::clone(assets);
            self.state = state;
            Ok(())
        }
    };
}
pub(crate) use shared_methods;
