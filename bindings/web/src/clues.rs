//! The commands that an episode has shown so far and a player should remember, read from the features by their names.

use endless_gym_core::envs::EnvSpec;

/// Prefix of the features that are 1 while a command is shown.
const COMMAND: &str = "command_";

/// The commands that were shown, in order.
pub struct Clues {
    /// Index and command of each of these features.
    columns: Vec<(usize, String)>,
    /// The index in `columns` of the command that the last observation showed.
    visible: Option<usize>,
    shown: Vec<String>,
}

impl Clues {
    pub fn new(spec: &EnvSpec) -> Self {
        let names = spec.features.iter().map(|column| column.name).enumerate();
        let commands = names.filter_map(|(index, name)| Some((index, name.strip_prefix(COMMAND)?.replace('_', " "))));
        Clues { columns: commands.collect(), visible: None, shown: Vec::new() }
    }

    /// Forgets the episode.
    pub fn reset(&mut self) {
        self.visible = None;
        self.shown.clear();
    }

    /// Records a command that was not visible in the previous observation.
    pub fn observe(&mut self, features: &[f32]) {
        let visible = self.columns.iter().position(|(index, _)| features.get(*index) == Some(&1.0));
        if let Some(command) = visible.filter(|_| visible != self.visible) {
            self.shown.push(self.columns[command].1.clone());
        }
        self.visible = visible;
    }

    /// The commands, such as `right down`; empty if there are none.
    pub fn shown(&self) -> &[String] {
        &self.shown
    }
}
