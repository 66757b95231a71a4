//! Slices: the cells of an experiment that one of several machines computes, and the files with which engines start all.
//!
//! Every slice writes its cells into the same folder. The command without a slice finds them there, computes what is
//! missing, and writes the table.

use std::fmt;
use std::ops::Range;
use std::path::Path;
use std::str::FromStr;

/// Largest number of slices.
const MOST_SLICES: usize = 10_000;

/// Slice `number` of `count`, counted from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Slice {
    number: usize,
    count: usize,
}

impl Slice {
    /// The slice of a task of a Slurm array, from its environment; `None` outside an array.
    ///
    /// # Errors
    /// The rule for slices when the variables name none.
    pub fn of_slurm(variable: impl Fn(&str) -> Option<String>) -> Result<Option<Self>, String> {
        let names = ["SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_COUNT"];
        let [Some(task), Some(count)] = names.map(&variable) else {
            return Ok(None);
        };
        let slice = format!("{task}/{count}").parse();
        slice
            .map(Some)
            .map_err(|_| refusal(&format!("{}={task}, {}={count}", names[0], names[1])))
    }

    /// Places of the cells of this slice, of `cells` in the order of the experiment. Cells of one encoder are
    /// neighbours in that order, so that most are in one slice.
    pub fn part(self, cells: usize) -> Range<usize> {
        // Both ends are rounded down alike, so that neighbouring slices meet without a gap.
        cells * (self.number - 1) / self.count..cells * self.number / self.count
    }
}

impl FromStr for Slice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parsed = text.split_once('/').and_then(|(number, count)| {
            let (number, count) = (number.parse().ok()?, count.parse().ok()?);
            ((1..=count).contains(&number) && count <= MOST_SLICES)
                .then_some(Self { number, count })
        });
        parsed.ok_or_else(|| refusal(text))
    }
}

/// Message on a text or an environment that names no slice.
fn refusal(text: &str) -> String {
    format!("{text}: a slice is M/N, with M from 1 to N and N up to {MOST_SLICES}")
}

impl fmt::Display for Slice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.number, self.count)
    }
}

/// Program that starts slices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Engine {
    /// A shell script for Slurm: an array of tasks, and a task that waits for all of them.
    Slurm,
    /// A shell script for GNU parallel on one machine.
    Parallel,
    /// A Snakefile.
    Snakemake,
}

impl Engine {
    /// The file with which the engine runs `count` slices of `command`, and `command` itself when all have ended.
    ///
    /// `result` is a file that `command` writes at its end.
    pub fn file(self, command: &[&str], count: usize, result: &Path) -> String {
        let command: Vec<String> = command.iter().map(|word| quoted(word)).collect();
        let command = command.join(" ");
        match self {
            // The slice of a task is in its environment.
            Self::Slurm => format!(
                "#!/usr/bin/env bash\n\
                 # Options of sbatch (--partition, --time, ..) are taken from SBATCH_* variables.\n\
                 set -euo pipefail\n\
                 slices=$(sbatch --parsable --array=1-{count} --cpus-per-task=1 --wrap {wrapped})\n\
                 sbatch --parsable --wait --kill-on-invalid-dep=yes --dependency=afterok:\"$slices\" --cpus-per-task=1 --wrap {wrapped}\n",
                wrapped = quoted(&command),
            ),
            // GNU parallel hands its words to a shell once more, so the quoted command is quoted again.
            Self::Parallel => format!(
                "#!/usr/bin/env bash\n\
                 set -euo pipefail\n\
                 seq {count} | parallel {} --slice {{}}/{count}\n\
                 {command}\n",
                quoted(&command),
            ),
            Self::Snakemake => snakemake(&command, count, result),
        }
    }
}

fn snakemake(command: &str, count: usize, result: &Path) -> String {
    let result = result.display();
    let [table, slices] =
        [format!("{result}"), format!("{result}.slices/")].map(|text| python(&text));
    let command = python(command);
    format!(
        "rule table:\n    \
             input: expand({slices} + \"{{slice}}\", slice=range(1, {count} + 1))\n    \
             output: {table}\n    \
             shell: {command}\n\n\
         rule slice:\n    \
             output: touch({slices} + \"{{slice}}\")\n    \
             shell: {command} + \" --slice {{wildcards.slice}}/{count}\"\n",
    )
}

/// A text as a string of Python, with braces that Snakemake leaves alone. JSON has the escapes that Python has.
fn python(text: &str) -> String {
    serde_json::Value::from(text.replace('{', "{{").replace('}', "}}")).to_string()
}

/// A word as a shell reads it back.
fn quoted(word: &str) -> String {
    let is_plain = word
        .chars()
        .all(|c| c.is_ascii_alphanumeric() || "/._-=,:+".contains(c));
    if !word.is_empty() && is_plain {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', r"'\''"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cell_is_in_exactly_one_slice() {
        for (cells, count) in [(0, 1), (5, 7), (12, 5), (100, 3), (499, 39)] {
            let slices = (1..=count).map(|number| Slice { number, count });
            let places: Vec<usize> = slices.flat_map(|slice| slice.part(cells)).collect();
            assert_eq!(places, (0..cells).collect::<Vec<_>>());
        }
    }

    fn slice_of_slurm_array(task: &str, count: &str) -> Result<Option<Slice>, String> {
        Slice::of_slurm(|name| match name {
            "SLURM_ARRAY_TASK_ID" => Some(task.to_owned()),
            "SLURM_ARRAY_TASK_COUNT" => Some(count.to_owned()),
            _ => None,
        })
    }

    #[test]
    fn a_slice_is_read_from_text_or_from_the_environment_of_an_array() {
        assert_eq!(
            "2/3".parse(),
            Ok(Slice {
                number: 2,
                count: 3
            })
        );
        for text in ["0/3", "4/3", "2", "a/b", "1/0", "-1/3", "1/10001"] {
            let error = text.parse::<Slice>().unwrap_err().to_string();
            assert!(
                error.starts_with(&format!("{text}: a slice is M/N")),
                "{error}"
            );
        }
        assert_eq!(
            slice_of_slurm_array("3", "3"),
            Ok(Some(Slice {
                number: 3,
                count: 3
            }))
        );
        assert!(
            slice_of_slurm_array("7", "3")
                .unwrap_err()
                .to_string()
                .contains("SLURM_ARRAY_TASK_ID=7")
        );
        assert_eq!(Slice::of_slurm(|_| None), Ok(None));
    }

    #[test]
    fn files_of_engines_run_every_slice_and_then_the_command() {
        let command = ["v2vloc", "sweep", "a b.yaml", "--out", "out"];
        let result = Path::new("out/a.csv");
        let slurm = Engine::Slurm.file(&command, 4, result);
        assert!(slurm.contains("--array=1-4"));
        assert!(slurm.contains(r"--wrap 'v2vloc sweep '\''a b.yaml'\'' --out out'"));
        let parallel = Engine::Parallel.file(&command, 4, result);
        assert!(
            parallel.ends_with("--slice {}/4\nv2vloc sweep 'a b.yaml' --out out\n"),
            "{parallel}"
        );
        let snakefile = Engine::Snakemake.file(&command, 4, result);
        assert!(
            snakefile.contains("--slice {wildcards.slice}/4"),
            "{snakefile}"
        );
        assert!(snakefile.contains("output: \"out/a.csv\""), "{snakefile}");
        let odd = Engine::Snakemake.file(&command, 1, Path::new("a \"{b}.csv"));
        assert!(odd.contains(r#"output: "a \"{{b}}.csv""#), "{odd}");
    }
}
