//! Checks of a scenario: values, contradictions between fields, files that exist.

use std::path::Path;

use bus::Endpoint;
use bus::config_file::ConfigError;
use perception::compute_device::ComputeDevice;
use protocol::config::{FieldError, above_zero, within};

use super::{Clock, Scenario, ScenarioError};

impl Scenario {
    /// Checks the values of the fields and that what they name exists.
    ///
    /// # Errors
    /// [`ScenarioError`] for the first invalid field, by path.
    pub fn check(&self, path: &Path) -> Result<(), ScenarioError> {
        self.check_values().map_err(|error| ConfigError::Value {
            path: Some(path.into()),
            error,
        })?;
        self.check_files(path)
    }

    fn check_values(&self) -> Result<(), FieldError> {
        self.check_numbers()?;
        self.check_clock()?;
        self.models.validate()?;
        self.check_security()?;
        self.check_network()?;
        match &self.ego.id {
            Some(ego) if !self.scene.agents.is_empty() && !self.scene.agents.contains(ego) => Err(
                FieldError::new("ego.id", ego, "must be one of scene.agents"),
            ),
            _ => Ok(()),
        }
    }

    fn check_numbers(&self) -> Result<(), FieldError> {
        let Self {
            scene,
            network,
            timeouts,
            ..
        } = self;
        for (field, number) in [
            ("scene.rate", scene.rate),
            ("network.stall_limit_s", network.stall_limit_s),
            ("timeouts.ready_s", timeouts.ready_s),
            ("timeouts.drain_s", timeouts.drain_s),
            ("timeouts.stop_s", timeouts.stop_s),
            ("timeouts.hang_s", timeouts.hang_s),
        ] {
            above_zero(field, number)?;
        }
        scene.validate()?;
        self.ego.validate()?;
        self.settings()
            .try_for_each(|settings| settings.validate())?;
        self.record
            .as_ref()
            .map_or(Ok(()), |record| record.validate())
    }

    fn check_network(&self) -> Result<(), FieldError> {
        let listen = [("network.listen", &self.network.listen)];
        for (field, text) in listen.into_iter().chain(
            self.network
                .connect
                .iter()
                .map(|at| ("network.connect", at)),
        ) {
            match Endpoint::new(text) {
                Err(_) => {
                    return Err(FieldError::new(
                        field,
                        text,
                        "must read tcp/ADDRESS:PORT or quic/ADDRESS:PORT",
                    ));
                }
                Ok(endpoint) if endpoint.is_secured() && self.security.is_none() => {
                    return Err(FieldError::new(
                        field,
                        text,
                        "must begin with tcp/, or security must be given",
                    ));
                }
                Ok(_) => {}
            }
        }
        match self.network.metrics {
            Some(metrics) if metrics.port() == 0 => {
                let rule = "must name a port: the other processes take those behind it";
                Err(FieldError::new("network.metrics", metrics, rule))
            }
            _ => Ok(()),
        }
    }

    /// Checks that files and folders that are named exist.
    fn check_files(&self, path: &Path) -> Result<(), ScenarioError> {
        let keys = self
            .security
            .iter()
            .flat_map(|security| &security.keys)
            .map(|keys| ("security.keys", keys.clone()));
        let poses = self.settings().flat_map(|settings| {
            settings
                .pose
                .files()
                .into_iter()
                .map(Path::to_owned)
                .collect::<Vec<_>>()
        });
        let places = [
            ("scene.dir", self.scene.dir.clone()),
            ("models.weights", self.models.weights.clone()),
        ];
        let places = places
            .into_iter()
            .chain(keys)
            .chain(poses.map(|file| ("agents.pose", file)));
        for (field, missing) in places {
            if !missing.exists() {
                return Err(ScenarioError::Missing {
                    path: path.into(),
                    field,
                    missing,
                });
            }
        }
        Ok(())
    }

    fn check_security(&self) -> Result<(), FieldError> {
        let Some(security) = &self.security else {
            return Ok(());
        };
        let elsewhere = self.network.connect.is_some() || !self.remote_agents.is_empty();
        if security.keys.is_none() && elsewhere {
            let rule = "must name the folder of `v2vloc keys`: processes on other hosts need keys of the same authority";
            return Err(FieldError::new("security.keys", "left out", rule));
        }
        match &self.network.connect {
            Some(router) if self.clock == Clock::Stepped => {
                let rule = "runs in simulation time are their own router when there is security";
                Err(FieldError::new("network.connect", router, rule))
            }
            _ => Ok(()),
        }
    }

    /// Checks that no field contradicts the clock: simulation time has no pace, no waiting and no other hosts.
    fn check_clock(&self) -> Result<(), FieldError> {
        if self.clock == Clock::Wall {
            return match self.stepped {
                Some(_) => Err(FieldError::new(
                    "stepped",
                    "given",
                    "must be left out unless clock is stepped",
                )),
                None => Ok(()),
            };
        }
        if self.scene.rate != 1.0 {
            return Err(FieldError::new(
                "scene.rate",
                self.scene.rate,
                "must be 1 with clock stepped, which has no pace",
            ));
        }
        for (field, is_set) in [
            ("scene.loop", self.scene.repeat),
            ("scene.lockstep", self.scene.lockstep),
        ] {
            if is_set {
                return Err(FieldError::new(
                    field,
                    "true",
                    "must be false with clock stepped",
                ));
            }
        }
        if self.models.device != ComputeDevice::Cpu {
            let rule =
                "must be cpu with clock stepped, whose results are the same bytes on any machine";
            return Err(FieldError::new("models.device", "cuda", rule));
        }
        if self.record.is_some() {
            let rule = "must be left out with clock stepped, whose processes publish nothing";
            return Err(FieldError::new("record", "given", rule));
        }
        if let Some(metrics) = self.network.metrics {
            return Err(FieldError::new(
                "network.metrics",
                metrics,
                "must be left out with clock stepped",
            ));
        }
        if let Some(cav) = self.remote_agents.first() {
            let rule = "must be left out with clock stepped, whose processes run here";
            return Err(FieldError::new("remote_agents", cav, rule));
        }
        let Some(compute) = self.stepped.and_then(|stepped| stepped.compute) else {
            return Ok(());
        };
        within("stepped.compute.pose_ms", compute.pose_ms, 0.0, 60_000.0)?;
        within("stepped.compute.map_ms", compute.map_ms, 0.0, 60_000.0)?;
        within("stepped.compute.fuse_ms", compute.fuse_ms, 0.0, 60_000.0)
    }
}
