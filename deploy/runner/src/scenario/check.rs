//! Checks of a scenario: values, contradictions between fields, files that exist.

use std::path::Path;

use bus::Endpoint;
use ego_fuser::config::PaceMode;
use localization::pose_source::PoseSourceConfig;
use perception::compute_device::ComputeDevice;
use protocol::config::{FieldError, above_zero, require, within};
use support::file_error::{AtFile, FileError};

use super::{Clock, Scenario};

impl Scenario {
    /// Checks the values of the fields and that what they name exists.
    ///
    /// # Errors
    /// [`FileError`] for the first invalid field, by path.
    pub fn check(&self, path: &Path) -> Result<(), FileError> {
        self.check_values().at(path)?;
        self.check_files(path)
    }

    fn check_values(&self) -> Result<(), FieldError> {
        self.check_numbers()?;
        self.check_clock()?;
        self.models.validate()?;
        self.check_security()?;
        self.check_network()?;
        // After the first lap no capture time is one of the table.
        let is_cached = |pose: PoseSourceConfig| matches!(pose, PoseSourceConfig::Cached(_));
        let is_looped = self.scene.repeat && self.poses().into_iter().any(is_cached);
        let rule = "must be false with agents.pose cached: its table has the times of one lap only";
        require(!is_looped, "scene.loop", true, rule)?;
        let is_paced = self.link.is_none() || self.scene.rate == 1.0;
        let rule = "must be 1 with link, whose delays and rates are those of the scene";
        require(is_paced, "scene.rate", self.scene.rate, rule)?;
        match &self.ego.id {
            Some(ego) if !self.scene.agents.is_empty() && !self.scene.agents.contains(ego) => Err(
                FieldError::new("ego.id", ego, "must be one of scene.agents"),
            ),
            _ => Ok(()),
        }
    }

    fn check_numbers(&self) -> Result<(), FieldError> {
        let (scene, network, timeouts) = (&self.scene, &self.network, &self.timeouts);
        for (field, number) in [
            ("scene.rate", scene.rate),
            ("timeouts.ready_s", timeouts.ready_s),
            ("timeouts.drain_s", timeouts.drain_s),
            ("timeouts.stop_s", timeouts.stop_s),
            ("timeouts.hang_s", timeouts.hang_s),
        ] {
            above_zero(field, number)?;
        }
        // As the router takes it.
        within("network.stall_limit_s", network.stall_limit_s, 0.1, 3600.0)?;
        scene.validate()?;
        self.ego.validate()?;
        let needed = self.method.exchange().stream();
        let in_processes =
            self.clock == Clock::Wall || self.stepped.is_some_and(|stepped| stepped.processes);
        self.settings().try_for_each(|settings| {
            settings.validate()?;
            settings.check_attack(&settings.sent_for(needed), in_processes)
        })?;
        self.record.iter().try_for_each(|record| record.validate())
    }

    fn check_network(&self) -> Result<(), FieldError> {
        let listen = [("network.listen", &self.network.listen)].into_iter();
        let connect = self.network.connect.iter();
        let connect = connect.map(|at| ("network.connect", at));
        for (field, text) in listen.chain(connect) {
            let rule = match text.parse::<Endpoint>() {
                Err(_) => "must read tcp/ADDRESS:PORT or quic/ADDRESS:PORT",
                // QUIC needs the certificates of the security section.
                Ok(endpoint) if endpoint.is_secured() && self.security.is_none() => {
                    "must begin with tcp/, or security must be given"
                }
                Ok(_) => continue,
            };
            return Err(FieldError::new(field, text, rule));
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
    fn check_files(&self, path: &Path) -> Result<(), FileError> {
        let mut places = vec![
            ("scene.dir", self.scene.dir.clone()),
            ("models.weights", self.models.weights.clone()),
        ];
        let keys = self.security.iter().flat_map(|security| &security.keys);
        places.extend(keys.map(|keys| ("security.keys", keys.clone())));
        for settings in self.settings() {
            let files = settings.pose.files().into_iter();
            places.extend(files.map(|file| ("agents.pose", file)));
            places.extend(settings.weights.map(|file| ("agents.weights", file)));
        }
        if let Some((field, missing)) = places.iter().find(|(_, file)| !file.exists()) {
            let problem = format_args!("{field}: {} does not exist", missing.display());
            return Err(FileError::new(path, problem));
        }
        Ok(())
    }

    fn check_security(&self) -> Result<(), FieldError> {
        let Some(security) = &self.security else {
            return Ok(());
        };
        let elsewhere = self.network.connect.is_some() || !self.remote_agents.is_empty();
        let rule = "must name the folder of `v2vloc keys`: processes on other hosts need keys of the same authority";
        let is_sound = security.keys.is_some() || !elsewhere;
        require(is_sound, "security.keys", format_args!("left out"), rule)
    }

    /// Checks that no field contradicts the clock: simulation time has no pace, no waiting and no other hosts.
    fn check_clock(&self) -> Result<(), FieldError> {
        if self.clock == Clock::Wall {
            let rule = "must be left out unless clock is stepped";
            let is_left_out = self.stepped.is_none();
            return require(is_left_out, "stepped", format_args!("given"), rule);
        }
        let (scene, remote) = (&self.scene, self.remote_agents.first());
        let (pace, metrics) = (self.ego.pace != PaceMode::Auto, self.network.metrics);
        let is_secured = self.security.is_some();
        let watched = self.settings().any(|settings| settings.rate.watch_queue);
        let watched = watched.then(|| "true".into());
        let off = "must be false with clock stepped";
        let own = "runs in simulation time have a router of their own when there is security";
        let connect = self.network.connect.clone();
        let auto = "must be auto with clock stepped, which computes every sweep";
        let out = "must be left out with clock stepped, which runs here and publishes nothing";
        let refused = [
            (
                "scene.rate",
                (scene.rate != 1.0).then(|| scene.rate.to_string()),
                "must be 1 with clock stepped, which has no pace",
            ),
            ("scene.loop", scene.repeat.then(|| "true".into()), off),
            ("agents.rate.watch_queue", watched, off),
            ("scene.lockstep", scene.lockstep.then(|| "true".into()), off),
            ("ego.pace", pace.then(|| "every_sweep".into()), auto),
            (
                "models.device",
                (self.models.device != ComputeDevice::Cpu).then(|| "cuda".into()),
                "must be cpu with clock stepped, whose results are the same bytes on any machine",
            ),
            ("record", self.record.as_ref().map(|_| "given".into()), out),
            ("network.connect", connect.filter(|_| is_secured), own),
            ("network.metrics", metrics.map(|at| at.to_string()), out),
            ("remote_agents", remote.map(ToString::to_string), out),
        ];
        for (field, found, rule) in refused {
            if let Some(found) = found {
                return Err(FieldError::new(field, found, rule));
            }
        }
        let compute = self.stepped.and_then(|stepped| stepped.compute);
        compute.map_or(Ok(()), |compute| compute.validate("stepped.compute"))
    }
}
