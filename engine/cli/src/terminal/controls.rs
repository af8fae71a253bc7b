//! What the keys choose: directions where choices are named after them, and otherwise numbers of choices or of a box.

use endless_gym_core::envs::{ActionSpace, EnvSpec};

use super::keys::Direction;

/// Choices up to which a digit alone names one.
const DIGITS: i32 = 10;

/// Changes of a box's number by which a key goes from one bound to the other.
const CHANGES: f32 = 20.0;

/// Change of a number whose bounds are infinite.
const CHANGE: f32 = 0.1;

/// The action of a person.
#[derive(Debug)]
pub struct Controls {
    spec: EnvSpec,
    /// The numbers that count where no direction is held, as in an action.
    chosen: Vec<i32>,
    /// The branches of which directions do not name every choice but 0, or the dimensions of a box.
    free: Vec<usize>,
    /// The place in `free` that keys change.
    selected: usize,
    /// Whether the next digit continues the number.
    is_typing: bool,
}

impl Controls {
    pub fn new(spec: &EnvSpec) -> Self {
        let branches = spec.action_space.branches();
        let is_free =
            |branch: &usize| (1..branches[*branch] as usize).any(|choice| direction(spec, *branch, choice).is_none());
        let (chosen, free) = match &spec.action_space {
            ActionSpace::Box { low, high } => {
                let zero = low.iter().zip(high.iter()).map(|(low, high)| 0.0_f32.clamp(*low, *high));
                (zero.map(|number| number.to_bits().cast_signed()).collect(), (0..low.len()).collect())
            }
            _ => (vec![0; branches.len()], (0..branches.len()).filter(is_free).collect()),
        };
        Controls { spec: spec.clone(), chosen, free, selected: 0, is_typing: false }
    }

    /// Whether the game goes on while no key is pressed: in a box, and where doing nothing is a choice that no direction names.
    pub fn is_timed(&self) -> bool {
        let waits = |branch: usize| direction(&self.spec, branch, 0).is_some();
        matches!(self.spec.action_space, ActionSpace::Box { .. })
            || self.has_directions() && !(0..self.chosen.len()).any(waits)
    }

    pub fn has_directions(&self) -> bool {
        let branches = self.spec.action_space.branches().iter().enumerate();
        branches
            .flat_map(|(branch, choices)| (0..*choices as usize).map(move |choice| (branch, choice)))
            .any(|(branch, choice)| direction(&self.spec, branch, choice).is_some())
    }

    /// A key for these directions. Returns whether it is a movement; otherwise it changes the selected number.
    pub fn press(&mut self, directions: &[Direction]) -> bool {
        if self.has_directions() {
            return true;
        }
        let ([one], Some(at)) = (directions, self.free.get(self.selected).copied()) else { return false };
        let sign = if matches!(one, Direction::Right | Direction::Up) { 1 } else { -1 };
        self.is_typing = false;
        self.chosen[at] = match &self.spec.action_space {
            ActionSpace::Box { low, high } => {
                let (low, high) = (low[at], high[at]);
                let change = if (high - low).is_finite() { (high - low) / CHANGES } else { CHANGE };
                let number = f32::from_bits(self.chosen[at].cast_unsigned()) + sign as f32 * change;
                // A sum of changes is not quite 0.
                let number = if number.abs() < change / 2.0 { 0.0 } else { number };
                number.clamp(low, high).to_bits().cast_signed()
            }
            space => (self.chosen[at] + sign).clamp(0, space.branches()[at] - 1),
        };
        false
    }

    /// A digit. Returns whether it completes an action that waits for one.
    pub fn digit(&mut self, digit: i32) -> bool {
        let Some(at) = self.free.get(self.selected).copied() else { return false };
        let Some(choices) = self.spec.action_space.branches().get(at) else {
            // In a box, only 0 has a meaning.
            if digit == 0 {
                self.chosen[at] = Controls::new(&self.spec).chosen[at];
            }
            return false;
        };
        let longer = self.chosen[at].saturating_mul(DIGITS).saturating_add(digit);
        let number = if self.is_typing && longer < *choices { longer } else { digit };
        if number >= *choices {
            return false;
        }
        self.chosen[at] = number;
        self.is_typing = *choices > DIGITS;
        self.plays_digits()
    }

    /// Whether a digit is an action.
    fn plays_digits(&self) -> bool {
        !self.is_timed() && matches!(self.spec.action_space.branches(), [choices] if *choices <= DIGITS)
    }

    /// Selects the next number.
    pub fn select(&mut self) {
        self.is_typing = false;
        self.selected = (self.selected + 1) % self.free.len().max(1);
    }

    /// The action of a step in which these directions are held. In each branch, the last one that it has counts.
    pub fn action(&mut self, directions: &[Direction]) -> Vec<i32> {
        self.is_typing = false;
        let steered = |branch| {
            let choices = 0..*self.spec.action_space.branches().get(branch)? as usize;
            let choice =
                |held: &Direction| choices.clone().find(|choice| direction(&self.spec, branch, *choice) == Some(*held));
            directions.iter().rev().find_map(choice)
        };
        let number = |(branch, chosen): (usize, &i32)| steered(branch).map_or(*chosen, |choice| choice as i32);
        self.chosen.iter().enumerate().map(number).collect()
    }

    /// Whether a step without a direction is one of the person's choice.
    pub fn can_play_chosen(&self) -> bool {
        self.is_timed() || !self.free.is_empty()
    }

    /// The numbers that are chosen, the selected one in brackets; empty if there is nothing to choose.
    pub fn chosen(&self) -> String {
        let shown = |(place, at): (usize, &usize)| {
            let text = match &self.spec.action_space {
                ActionSpace::Box { low, high } => {
                    let number = f32::from_bits(self.chosen[*at].cast_unsigned());
                    format!("{} {number:.2} in {} to {}", self.name(*at), low[*at], high[*at])
                }
                _ => format!("{} {}", self.name(*at), choice_name(&self.spec, *at, self.chosen[*at] as usize)),
            };
            if place == self.selected { format!("[{text}]") } else { text }
        };
        self.free.iter().enumerate().map(shown).collect::<Vec<_>>().join("  ")
    }

    fn name(&self, branch: usize) -> String {
        match self.spec.actions.get(branch) {
            Some(branch) => branch.name.to_owned(),
            None if self.chosen.len() == 1 => "action".to_owned(),
            None => format!("action {branch}"),
        }
    }

    /// The help for the keys.
    pub fn help(&self) -> String {
        let mut parts = Vec::new();
        if self.has_directions() {
            let diagonal = if self.chosen.len() > 1 { ", Q E Z C diagonally" } else { "" };
            parts.push(format!("arrows or W A S D move{diagonal}"));
        } else if !self.free.is_empty() {
            parts.push("arrows change the number in brackets".to_owned());
        }
        let branches = self.spec.action_space.branches();
        let verb = if self.plays_digits() { "play" } else { "choose" };
        match self.free.get(self.selected).map(|at| (*at, branches.get(*at).copied())) {
            Some((at, Some(choices))) if choices <= DIGITS => {
                let names = (0..choices as usize).map(|choice| match choice_name(&self.spec, at, choice) {
                    name if name == choice.to_string() => name,
                    name => format!("{choice} {name}"),
                });
                parts.push(format!("digits {verb} {}", names.collect::<Vec<_>>().join(" ")));
            }
            Some((_, Some(choices))) => parts.push(format!("digits choose 0 to {}", choices - 1)),
            Some((_, None)) => parts.push("0 resets it".to_owned()),
            None => {}
        }
        if self.free.len() > 1 {
            parts.push("Tab selects the next".to_owned());
        }
        if self.is_timed() {
            parts.push("Space pauses, N one step".to_owned());
        } else if !self.free.is_empty() {
            parts.push(
                if self.plays_digits() { "Enter plays the number in brackets" } else { "Enter plays" }.to_owned(),
            );
        }
        let quit = if self.has_directions() { "Esc" } else { "Q or Esc" };
        parts.push(format!("R restarts, PgUp/PgDn seed, {quit} quits"));
        parts.join(", ")
    }
}

/// The direction that a choice is named after.
fn direction(spec: &EnvSpec, branch: usize, choice: usize) -> Option<Direction> {
    match spec.actions.get(branch)?.choices.get(choice)?.name {
        "left" => Some(Direction::Left),
        "right" => Some(Direction::Right),
        "up" | "ahead" => Some(Direction::Up),
        "down" => Some(Direction::Down),
        _ => None,
    }
}

/// A choice's name, or its number.
fn choice_name(spec: &EnvSpec, branch: usize, choice: usize) -> String {
    let named = spec.actions.get(branch).and_then(|branch| branch.choices.get(choice));
    named.map_or_else(|| choice.to_string(), |choice| choice.name.to_owned())
}

#[cfg(test)]
mod tests {
    use endless_gym_core::envs::{ActionBranch, Choice, box_action};
    use endless_gym_memory_gym::memory_gym;

    use super::super::keys::Direction::{Down, Left, Right, Up};
    use super::*;

    const fn choice(name: &'static str) -> Choice {
        Choice { name, description: "" }
    }

    fn controls(space: ActionSpace, actions: &'static [ActionBranch]) -> Controls {
        Controls::new(&EnvSpec { actions, ..EnvSpec::new("Own-v0", "Own", space) })
    }

    #[test]
    fn directions_are_the_environments_actions() {
        let act = |id: &str, directions: &[Direction]| {
            let mut controls = Controls::new(memory_gym().spec(id).unwrap());
            assert!(controls.is_timed() && controls.press(directions) && controls.chosen().is_empty());
            controls.action(directions)
        };
        assert_eq!(act("MortarMayhem-v0", &[]), [0, 0]);
        assert_eq!(act("MortarMayhem-v0", &[Left, Down]), [1, 2]);
        assert_eq!(act("SearingSpotlights-v0", &[Right, Up]), [2, 1]);
        assert_eq!(act("MysteryPath-Grid-v0", &[Up]), [3]);
        assert_eq!(act("MysteryPath-Grid-v0", &[Down]), [0]);
        assert_eq!(act("Endless-MysteryPath-v0", &[Right, Up]), [2]);
        assert_eq!(act("Endless-MysteryPath-v0", &[Left]), [0]);
    }

    #[test]
    fn a_digit_plays_one_of_few_choices_and_several_digits_name_one_of_many() {
        let mut few = controls(ActionSpace::Discrete(3), &[]);
        assert!(!few.is_timed() && few.can_play_chosen());
        assert!(few.digit(2) && few.help().contains("digits play 0 1 2, Enter plays the number in brackets"));
        assert!(few.help().ends_with("Q or Esc quits"));
        assert_eq!(few.action(&[]), [2]);
        assert!(!few.digit(3), "there are three choices");
        assert_eq!(few.action(&[]), [2]);
        let mut many = controls(ActionSpace::Discrete(52), &[]);
        assert!(!many.digit(4) && !many.digit(1));
        assert_eq!((many.chosen().as_str(), many.action(&[])), ("[action 41]", vec![41]));
        many.digit(9);
        many.digit(9);
        assert_eq!(many.action(&[]), [9], "99 is too large, so the second digit starts a number");
        many.press(&[Up]);
        many.press(&[Left]);
        many.press(&[Right]);
        assert_eq!(many.action(&[]), [10]);
    }

    #[test]
    fn several_branches_are_selected_one_after_the_other() {
        let mut board = controls(ActionSpace::multi_discrete(&[8, 12]), &[]);
        assert!(!board.digit(5), "the column is missing");
        board.select();
        board.digit(1);
        board.digit(1);
        assert_eq!((board.chosen().as_str(), board.action(&[])), ("action 0 5  [action 1 11]", vec![5, 11]));
        board.select();
        (0..20).for_each(|_| assert!(!board.press(&[Down])));
        assert_eq!(board.action(&[]), [0, 11]);
    }

    #[test]
    fn directions_and_numbers_act_together() {
        const ACTIONS: &[ActionBranch] = &[
            ActionBranch { name: "move", choices: &[choice("stay"), choice("left"), choice("right")] },
            ActionBranch { name: "hand", choices: &[choice("open"), choice("closed")] },
        ];
        let mut mixed = controls(ActionSpace::multi_discrete(&[3, 2]), ACTIONS);
        assert!(mixed.is_timed() && mixed.press(&[Left]));
        assert!(!mixed.digit(1), "the game goes on by itself");
        assert_eq!((mixed.chosen().as_str(), mixed.action(&[Left])), ("[hand closed]", vec![1, 1]));
        assert!(
            mixed
                .help()
                .contains("arrows or W A S D move, Q E Z C diagonally, digits choose 0 open 1 closed, Space pauses")
        );
    }

    #[test]
    fn choices_that_are_all_directions_wait_for_one() {
        const ACTIONS: &[ActionBranch] = &[ActionBranch { name: "push", choices: &[choice("left"), choice("right")] }];
        let mut push = controls(ActionSpace::Discrete(2), ACTIONS);
        assert!(!push.is_timed() && !push.can_play_chosen() && push.press(&[Right]));
        assert_eq!(push.action(&[Right]), [1]);
        assert_eq!(push.help(), "arrows or W A S D move, R restarts, PgUp/PgDn seed, Esc quits");
    }

    #[test]
    fn keys_move_the_numbers_of_a_box_within_its_bounds() {
        let mut controls = controls(ActionSpace::bounded(&[-2.0, 3.0], &[2.0, f32::INFINITY]), &[]);
        let numbers = |controls: &mut Controls| box_action(&controls.action(&[])).to_vec();
        assert!(controls.is_timed());
        assert_eq!(numbers(&mut controls), [0.0, 3.0], "0, or the nearest number");
        (0..3).for_each(|_| assert!(!controls.press(&[Right])));
        assert!((numbers(&mut controls)[0] - 0.6).abs() < 1e-6);
        (0..3).for_each(|_| assert!(!controls.press(&[Left])));
        assert_eq!(numbers(&mut controls)[0].to_bits(), 0);
        (0..100).for_each(|_| assert!(!controls.press(&[Down])));
        assert_eq!(numbers(&mut controls)[0], -2.0);
        controls.digit(0);
        controls.select();
        controls.press(&[Up]);
        assert_eq!(numbers(&mut controls), [0.0, 3.1]);
        assert_eq!(controls.chosen(), "action 0 0.00 in -2 to 2  [action 1 3.10 in 3 to inf]");
    }
}
