//! `v2vloc keys`.

use std::path::PathBuf;

use crate::operate::keys::{KeyFileError, KeyPlan, make, principals_of};
use protocol::{CavId, Principal, Role};
use serde_json::json;
use support::output;

use support::cli::{BadInput, Outcome};

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Folder of the keys: one folder per process, and the authority's key, which belongs on no vehicle.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Vehicles: each gets a certificate for its agent.
    #[arg(long, value_name = "CAV,..", value_delimiter = ',')]
    agents: Vec<CavId>,
    /// Vehicles that fuse: each gets certificates for its ego-fuser and for the link in front of it.
    #[arg(long, value_name = "CAV,..", value_delimiter = ',')]
    egos: Vec<CavId>,
    /// Robots with a `v2vloc ros2 --robot` of their own: each gets a certificate for it.
    #[arg(long, value_name = "CAV,..", value_delimiter = ',', value_parser = super::robot)]
    robots: Vec<CavId>,
    /// Names or addresses of the router, in addition to localhost.
    #[arg(long, value_name = "HOST,..", value_delimiter = ',')]
    hosts: Vec<String>,
    /// Lifetime of the certificates, days.
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u32).range(1..=3650))]
    days: u32,
    /// Replace existing certificates; the authority stays.
    #[arg(long)]
    force: bool,
    /// Print the files as JSON.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Writes the keys and lists the files.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        let [mut principals, mut others] = principals_of(&self.agents, &self.egos);
        // Vehicles that are added later join a fleet whose other processes have certificates already.
        others.retain(|other| self.force || !self.out.join(other.to_string()).exists());
        principals.extend(others);
        let robots = self.robots.iter();
        principals.extend(robots.map(|robot| Principal::new(Role::Ros2, robot)));
        let mut plan = KeyPlan::new(&self.out, principals, self.days);
        plan.hosts.extend(self.hosts);
        plan.replace = self.force;
        let written = make(&plan).map_err(|error| match error {
            KeyFileError::File(_) => anyhow::Error::from(error),
            KeyFileError::There(_) | KeyFileError::Unusable { .. } => BadInput::of(error).into(),
        })?;
        if self.json {
            output::line(serde_json::to_string_pretty(&json!({ "files": written }))?)?;
        } else {
            let mut paths = written.iter();
            paths.try_for_each(|path| output::line(path.display()))?;
        }
        Ok(Outcome::Done)
    }
}
