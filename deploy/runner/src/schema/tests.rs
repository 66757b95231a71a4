//! Tests that files, command lines and schemas agree.

use std::path::PathBuf;

use agent::config::AgentConfig;
use bus::{Configured, ProcessConfig, minimal};
use clap::{Arg, Args, Command};
use ego_fuser::config::EgoConfig;
use schemars::JsonSchema;
use serde_json::Value;
use sim_replay::config::{LinkProcessConfig, RecorderConfig, ReplayConfig};

use super::*;

/// Every kind of file, with the path of its schema below `deploy`.
const ALL: [(SchemaOf, &str); 3] = [
    (SchemaOf::Scenario, "scenarios/scenario.schema.json"),
    (SchemaOf::Experiment, "experiments/experiment.schema.json"),
    (SchemaOf::Link, "experiments/links/link.schema.json"),
];

fn deploy() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("..")
}

#[test]
fn the_schemas_beside_the_files_are_those_of_the_types() {
    for (kind, place) in ALL {
        let written = std::fs::read_to_string(deploy().join(place)).unwrap_or_default();
        let name = format!("{kind:?}").to_lowercase();
        assert!(
            written == kind.json(),
            "deploy/{place} is not what `v2vloc schema {name}` prints"
        );
    }
}

#[test]
fn every_file_names_its_schema_in_its_first_line() {
    let mut files = 0;
    for folder in [
        "scenarios",
        "experiments",
        "experiments/links",
        "results/security",
    ] {
        for entry in std::fs::read_dir(deploy().join(folder)).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_some_and(|kind| kind == "yaml") {
                let text = std::fs::read_to_string(&path).unwrap();
                let first = text.lines().next().unwrap_or_default();
                let schema = first
                    .strip_prefix("# yaml-language-server: $schema=")
                    .unwrap_or("none");
                assert!(
                    path.with_file_name(schema).is_file(),
                    "{}: {first}",
                    path.display()
                );
                files += 1;
            }
        }
    }
    assert!(files >= 10, "{files}");
}

#[test]
fn every_setting_of_a_process_is_an_option_with_the_same_name_and_default() {
    agree::<AgentConfig>();
    agree::<EgoConfig>();
    agree::<ReplayConfig>();
    agree::<LinkProcessConfig>();
    agree::<RecorderConfig>();
}

#[test]
fn a_scenario_and_an_experiment_are_made_of_the_types_of_the_processes() {
    let (agent, ego, replay) = (
        schema_of::<AgentConfig>(),
        schema_of::<EgoConfig>(),
        schema_of::<ReplayConfig>(),
    );
    let [scenario, experiment] = [SchemaOf::Scenario, SchemaOf::Experiment]
        .map(|kind| serde_json::from_str::<Value>(&kind.json()).unwrap());
    for (process, name) in [
        (&agent, "AgentSettings"),
        (&agent, "ModelConfig"),
        (&ego, "EgoSettings"),
        (&replay, "SceneConfig"),
    ] {
        assert!(definition(process, name).is_object(), "{name}");
        assert_eq!(
            definition(&scenario, name),
            definition(process, name),
            "{name}"
        );
    }
    for (process, name) in [
        (&ego, "EgoSettings"),
        (&agent, "PoseSourceConfig"),
        (&agent, "NoiseMode"),
    ] {
        assert_eq!(
            definition(&experiment, name),
            definition(process, name),
            "{name}"
        );
    }
}

fn definition<'a>(schema: &'a Value, name: &str) -> &'a Value {
    &schema["definitions"][name]
}

fn schema_of<T: JsonSchema>() -> Value {
    let generator = SchemaGenerator::new(SchemaSettings::draft07());
    generator.into_root_schema_for::<T>().to_value()
}

/// Setting beside the recorder's that `v2vloc up` gives to other processes.
const OF_OTHER_PROCESSES: &str = "record.inputs";

/// Compares the fields of a configuration with its schema and its options.
fn agree<C: ProcessConfig + JsonSchema>() {
    let defaults = serde_json::to_value(minimal::<C>(|_| "x".into()).unwrap()).unwrap();
    let schema = schema_of::<C>();
    let command = Configured::<C>::augment_args(Command::new("process"));
    let options: Vec<&Arg> = command.get_arguments().collect();
    let fields = fields(&schema, &schema);
    assert!(fields.len() > 10, "{fields:?}");
    for (path, described) in fields {
        if path == OF_OTHER_PROCESSES {
            continue;
        }
        let value = defaults.pointer(&format!("/{}", path.replace('.', "/")));
        let is_required = C::REQUIRED.contains(&path.as_str());
        // A field that is not written when absent has no default.
        if let Some(value) = value.filter(|_| !is_required) {
            assert_eq!(
                described.as_ref().unwrap_or(&Value::Null),
                value,
                "{path}: default in the schema"
            );
        }
        let names = names(&path);
        let option = options
            .iter()
            .find(|option| names.contains(&option.get_id().to_string()));
        let option = option.unwrap_or_else(|| panic!("{path}: no option of {names:?}"));
        let long = option.get_long().unwrap_or(option.get_id().as_str());
        assert!(names.contains(&long.replace('-', "_")), "{path}: --{long}");
        let help = option
            .get_help()
            .map(ToString::to_string)
            .unwrap_or_default();
        let quoted = value.filter(|_| !is_required).and_then(text);
        let has = quoted
            .as_ref()
            .is_none_or(|text| help.contains(&format!("[default: {text}]")));
        assert!(
            has,
            "{path}: help of --{long} does not name the default {quoted:?}: {help}"
        );
    }
}

/// Names that the option of a field may have: its own, or with the section before it.
fn names(path: &str) -> Vec<String> {
    let parts: Vec<&str> = path.split('.').collect();
    let mut names: Vec<String> = (0..parts.len())
        .map(|start| parts[start..].join("_"))
        .collect();
    match path {
        "settings.pose" => names.push("pose_source".into()),
        "ego.id" => names.push("ego".into()),
        _ => {}
    }
    names
}

/// Fields of a schema that are not sections, with their defaults.
fn fields(root: &Value, schema: &Value) -> Vec<(String, Option<Value>)> {
    let mut all = Vec::new();
    for (name, property) in schema["properties"].as_object().unwrap() {
        let reference = property["$ref"]
            .as_str()
            .or(property["allOf"][0]["$ref"].as_str());
        let target = reference.map_or(property, |path| {
            root.pointer(path.trim_start_matches('#')).unwrap()
        });
        if target.get("properties").is_some() {
            let inner = fields(root, target).into_iter();
            all.extend(inner.map(|(path, default)| (format!("{name}.{path}"), default)));
        } else {
            all.push((name.clone(), property.get("default").cloned()));
        }
    }
    all
}

fn text(value: &Value) -> Option<String> {
    match value {
        Value::Number(number) => Some(number.to_string()),
        Value::String(text) => Some(text.clone()),
        Value::Array(values) if !values.is_empty() => {
            Some(values.iter().filter_map(text).collect::<Vec<_>>().join(","))
        }
        _ => None,
    }
}

#[test]
fn the_options_of_pose_noise_are_its_fields() {
    let noise =
        serde_json::to_value(localization::pose_source::NoisyPoseConfig::default()).unwrap();
    let command = Configured::<AgentConfig>::augment_args(Command::new("agent"));
    for (name, value) in noise.as_object().unwrap() {
        let id = format!("noise_{name}");
        let option = command
            .get_arguments()
            .find(|option| option.get_id() == &id)
            .unwrap_or_else(|| panic!("{id}"));
        assert_eq!(option.get_long(), Some(id.replace('_', "-").as_str()));
        let help = option
            .get_help()
            .map(ToString::to_string)
            .unwrap_or_default();
        assert!(
            text(value).is_none_or(|text| help.contains(&format!("[default: {text}]"))),
            "{id}: {help}"
        );
    }
}
