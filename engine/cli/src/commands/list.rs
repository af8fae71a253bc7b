//! `endless list`.

use clap::ColorChoice;
use endless_gym_core::batch::Frames;
use endless_gym_core::envs::{ActionBranch, EnvSpec, Learnt};
use endless_gym_core::pool::Registry;
use serde_json::json;

use crate::failure::Failure;
use crate::output::{self, print, print_coloured, print_json, table};
use crate::picture::{applies, picture};

/// Arguments of `endless list`.
#[derive(clap::Args)]
pub struct Args {
    /// Environment id to describe [default: list all ids].
    id: Option<String>,
    /// Print JSON [default: text].
    #[arg(long, conflicts_with = "picture")]
    json: bool,
    /// When to show a picture of the environment made of coloured characters. With `auto`, in a terminal with 24-bit colours: COLORTERM
    /// is `truecolor` or `24bit`, and NO_COLOR is not set.
    #[arg(long, value_enum, value_name = "WHEN", default_value = "auto", requires = "id")]
    picture: ColorChoice,
}

/// Runs `endless list`.
pub fn run(registry: &Registry, args: &Args) -> Result<(), Failure> {
    match &args.id {
        Some(id) => {
            let spec = registry.spec(id)?;
            match () {
                _ if args.json => print_json(&as_json(spec)),
                _ if applies(args.picture) && spec.shown().is_some() => {
                    print_coloured(format_args!("{}\n{}", picture(registry, spec, output::width())?, description(spec)))
                }
                _ => print(description(spec)),
            }
        }
        None if args.json => print_json(&registry.specs().map(as_json).collect::<Vec<_>>()),
        None => {
            let mut rows = table(["environment", "actions", "observation", "task"]);
            for spec in registry.specs() {
                rows.add_row([spec.id, &spec.action_space.to_string(), &observation(spec), spec.summary]);
            }
            print(format_args!("{rows}\n\n`endless list ID` describes one environment and its reset parameters."))
        }
    }
}

fn observation(spec: &EnvSpec) -> String {
    let frame = spec.frame.map(|frame| format!("uint8 ({}, {}, {})", frame.width, frame.height, frame.channels));
    let length = if frame.is_none() { spec.features.len() } else { spec.vector_observation };
    let vector = (length > 0).then(|| match &spec.observation_space {
        Some(space) if frame.is_none() => space.to_string(),
        _ => format!("float32 ({length},)"),
    });
    frame.into_iter().chain(vector).collect::<Vec<_>>().join(" and ")
}

fn as_json(spec: &EnvSpec) -> serde_json::Value {
    let mut value = json!(spec);
    value["action_branches"] = json!(spec.action_space.branches());
    value["observation_shape"] = json!(spec.frame.map(|frame| Frames::default().shape(frame)));
    value
}

/// What the numbers of a branch mean, such as `0 nothing, 1 left, 2 right`.
fn choices(branch: &ActionBranch) -> String {
    let named: Vec<_> = branch.choices.iter().enumerate().map(|(n, choice)| format!("{n} {}", choice.name)).collect();
    named.join(", ")
}

/// Everything about one environment, as text.
fn description(spec: &EnvSpec) -> String {
    let mut parts = vec![format!("{}: {}\n", spec.id, spec.summary)];
    parts.push(format!("actions      {}", spec.action_space));
    parts.extend(spec.actions.iter().map(|branch| format!("  {}: {}", branch.name, choices(branch))));
    let index = if spec.frame.is_some() { ", indexed [x][y][channel]" } else { "" };
    parts.push(format!("observation  {}{index}", observation(spec)));
    if !spec.ground_truth.is_empty() {
        parts.push(format!("ground truth float64 ({},)", spec.ground_truth.len()));
    }
    if let Some(Learnt { name, mean }) =
        spec.learnt.filter(|learnt| spec.info.iter().any(|info| info.name == learnt.name))
    {
        parts.push(format!("learnt       at a mean {name} of {mean}"));
    }
    for (title, parameters) in [("argument (`ID?NAME=VALUE&..`)", spec.arguments), ("reset parameter", spec.parameters)]
    {
        let mut rows = table([title, "default", "allowed", "description"]);
        for parameter in parameters {
            rows.add_row([parameter.name, &parameter.default_text(), &parameter.allowed(), parameter.description]);
        }
        if !parameters.is_empty() {
            parts.push(format!("\n{rows}"));
        }
    }
    let truth: Vec<_> = spec.ground_truth.iter().map(|column| [column.name, column.description]).collect();
    let info: Vec<_> = spec.info.iter().map(|column| [column.name, column.description]).collect();
    let features: Vec<_> = spec.features.iter().map(|column| [column.name, column.description]).collect();
    let tables = [
        ("ground truth (`info[\"ground_truth\"]`)", truth),
        ("info of an episode's last step", info),
        ("feature (`endless serve --features`)", features),
    ];
    for (title, columns) in tables.into_iter().filter(|(_, columns)| !columns.is_empty()) {
        let mut rows = table([title, "description"]);
        for column in columns {
            rows.add_row(column);
        }
        parts.push(format!("\n{rows}"));
    }
    parts.join("\n")
}
