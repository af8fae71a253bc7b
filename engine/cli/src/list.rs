//! `endless list`.

use std::process::ExitCode;

use endless_gym_core::envs::{self, EnvSpec, SCREEN};
use serde_json::json;

use super::Failure;
use super::output::{print, print_json, table};

#[derive(clap::Args)]
pub struct Args {
    /// Environment id to show in full; all ids if left out.
    id: Option<String>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode, Failure> {
    match &args.id {
        Some(id) => {
            let spec = envs::spec(id)?;
            if args.json { print_json(&as_json(spec))? } else { show(spec) }
        }
        None if args.json => print_json(&envs::specs().map(as_json).collect::<Vec<_>>())?,
        None => {
            let mut rows = table(["environment", "actions", "observation", "what it asks for"]);
            for spec in envs::specs() {
                rows.add_row([spec.id, &spec.action_space.to_string(), &observation(spec), spec.summary]);
            }
            print(rows);
            print("\n`endless list ID` shows an environment's reset parameters.");
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn observation(spec: &EnvSpec) -> String {
    let frame = format!("uint8 ({SCREEN}, {SCREEN}, 3)");
    match spec.vector_observation {
        0 => frame,
        length => format!("{frame} and float32 ({length},)"),
    }
}

fn as_json(spec: &EnvSpec) -> serde_json::Value {
    let mut value = json!(spec);
    value["action_branches"] = json!(spec.action_space.branches());
    value["observation_shape"] = json!([SCREEN, SCREEN, 3]);
    value
}

fn show(spec: &EnvSpec) {
    print(format_args!("{}: {}\n", spec.id, spec.summary));
    print(format_args!("actions      {}", spec.action_space));
    print(format_args!("observation  {}, indexed [x][y][channel]", observation(spec)));
    if spec.ground_truth > 0 {
        print(format_args!("ground truth float64 ({},)", spec.ground_truth));
    }
    print("");
    let mut rows = table(["reset parameter", "default", "allowed", "meaning"]);
    for parameter in spec.parameters {
        rows.add_row([parameter.name, &parameter.default_text(), &parameter.allowed(), parameter.description]);
    }
    print(rows);
    let info: Vec<_> = spec.info.iter().map(|column| [column.name, column.description]).collect();
    let features: Vec<_> = spec.features.iter().map(|column| [column.name, column.description]).collect();
    for (title, columns) in [("info at an episode's end", info), ("feature (option `--features`)", features)] {
        let mut rows = table([title, "meaning"]);
        for column in columns {
            rows.add_row(column);
        }
        print(format_args!("\n{rows}"));
    }
}
