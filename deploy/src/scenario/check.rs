//! Whether what a scenario says makes sense.

use std::path::Path;

use bus::Endpoint;

use super::{Clock, Launch, Scenario, ScenarioError};

/// What rates and waiting times may be at most: 11 days, or a million a second.
const MOST: f64 = 1e6;

impl Scenario {
    /// Checks the values of the fields and that what they name exists.
    ///
    /// # Errors
    /// [`ScenarioError`] for the first field that makes no sense; `path` is named in it.
    pub fn check(&self, path: &Path) -> Result<(), ScenarioError> {
        self.check_numbers(path)?;
        self.check_clock(path)?;
        self.check_security(path)?;
        self.check_network(path)?;
        if let Some(ego) = &self.ego.id
            && !self.scene.agents.is_empty()
            && !self.scene.agents.contains(ego)
        {
            return Err(wrong(path, "ego.id", ego.to_string(), "must be one of scene.agents"));
        }
        self.check_models(path)
    }

    fn check_numbers(&self, path: &Path) -> Result<(), ScenarioError> {
        let Self { scene, ego, network, timeouts, models, .. } = self;
        for (field, number) in [
            ("scene.rate", scene.rate),
            ("ego.peer_messages_per_s", ego.peer_messages_per_s),
            ("ego.peer_mib_per_s", ego.peer_mib_per_s),
            ("network.stall_limit_s", network.stall_limit_s),
            ("timeouts.ready_s", timeouts.ready_s),
            ("timeouts.drain_s", timeouts.drain_s),
            ("timeouts.stop_s", timeouts.stop_s),
            ("timeouts.hang_s", timeouts.hang_s),
        ] {
            if !(number > 0.0 && number <= MOST) {
                return Err(wrong(path, field, number.to_string(), "must be a number above 0 and at most 1000000"));
            }
        }
        if scene.frames == Some(0) {
            return Err(wrong(path, "scene.frames", "0".into(), "must be at least 1"));
        }
        if !(1..=256).contains(&models.threads) {
            return Err(wrong(path, "models.threads", models.threads.to_string(), "must be 1 to 256"));
        }
        if ego.deadline_ms > 60_000 {
            return Err(wrong(path, "ego.deadline_ms", ego.deadline_ms.to_string(), "must be at most 60000"));
        }
        match self.record.as_ref().and_then(|record| record.zstd_level) {
            Some(level) if !(1..=22).contains(&level) => {
                Err(wrong(path, "record.zstd_level", level.to_string(), "must be 1 to 22"))
            }
            _ => Ok(()),
        }
    }

    fn check_network(&self, path: &Path) -> Result<(), ScenarioError> {
        let listen = [("network.listen", &self.network.listen)];
        for (field, text) in listen.into_iter().chain(self.network.connect.iter().map(|at| ("network.connect", at))) {
            match Endpoint::new(text) {
                Err(_) => {
                    return Err(wrong(path, field, text.clone(), "must read tcp/ADDRESS:PORT or quic/ADDRESS:PORT"));
                }
                Ok(endpoint) if endpoint.is_secured() && self.security.is_none() => {
                    return Err(wrong(path, field, text.clone(), "must begin with tcp/, or security must be given"));
                }
                Ok(_) => {}
            }
        }
        match self.network.metrics {
            Some(metrics) if metrics.port() == 0 => {
                let rule = "must name a port: the other processes take those behind it";
                Err(wrong(path, "network.metrics", metrics.to_string(), rule))
            }
            _ => Ok(()),
        }
    }

    fn check_models(&self, path: &Path) -> Result<(), ScenarioError> {
        let localizer = self.models.localizer.iter();
        if self.uses_localizer() && localizer.len() == 0 {
            let rule = "must name encoder and head: a vehicle's pose is pgc";
            return Err(wrong(path, "models.localizer", "left out".into(), rule));
        }
        if self.uses_end_to_end() && self.models.end_to_end.is_none() {
            let rule = "must name weights: a vehicle's pose is end_to_end";
            return Err(wrong(path, "models.end_to_end", "left out".into(), rule));
        }
        let networks = localizer.flat_map(|models| {
            [("models.localizer.encoder", &models.encoder), ("models.localizer.head", &models.head)]
        });
        let networks = networks.chain(self.models.end_to_end.iter().map(|weights| ("models.end_to_end", weights)));
        let places = [("scene.dir", &self.scene.dir), ("models.weights", &self.models.weights)];
        for (field, place) in places.into_iter().chain(networks) {
            if !place.exists() {
                return Err(ScenarioError::Missing { path: path.into(), field, missing: place.clone() });
            }
        }
        Ok(())
    }

    fn check_security(&self, path: &Path) -> Result<(), ScenarioError> {
        let Some(security) = &self.security else { return Ok(()) };
        if let Some(missing) = security.keys.as_ref().filter(|folder| !folder.is_dir()) {
            return Err(ScenarioError::Missing { path: path.into(), field: "security.keys", missing: missing.clone() });
        }
        let elsewhere = self.network.connect.is_some()
            || [&self.agents.launch]
                .into_iter()
                .chain(self.vehicles.values().filter_map(|own| own.launch.as_ref()))
                .any(|launch| *launch == Launch::Elsewhere);
        if security.keys.is_none() && elsewhere {
            let rule =
                "must name the folder of `v2vloc keys`: processes on other hosts need keys of the same authority";
            return Err(wrong(path, "security.keys", "left out".into(), rule));
        }
        if self.clock == Clock::Stepped && self.network.connect.is_some() {
            let rule = "runs in virtual time are their own router when there is security";
            let found = self.network.connect.clone().unwrap_or_default();
            return Err(wrong(path, "network.connect", found, rule));
        }
        Ok(())
    }

    /// Checks that nothing contradicts the clock: virtual time knows no pace, no waiting and no other hosts.
    fn check_clock(&self, path: &Path) -> Result<(), ScenarioError> {
        let value = |field, found: String, rule| Err(wrong(path, field, found, rule));
        if self.clock == Clock::Wall {
            return match self.stepped {
                Some(_) => value("stepped", "given".into(), "must be left out unless clock is stepped"),
                None => Ok(()),
            };
        }
        if self.scene.rate != 1.0 {
            return value("scene.rate", self.scene.rate.to_string(), "must be 1 with clock stepped, which has no pace");
        }
        for (field, is_set) in [("scene.loop", self.scene.repeat), ("scene.lockstep", self.scene.lockstep)] {
            if is_set {
                return value(field, "true".into(), "must be false with clock stepped");
            }
        }
        if self.record.is_some() {
            return value(
                "record",
                "given".into(),
                "must be left out with clock stepped, whose processes say nothing aloud",
            );
        }
        if let Some(metrics) = self.network.metrics {
            return value("network.metrics", metrics.to_string(), "must be left out with clock stepped");
        }
        let launches = self.vehicles.values().filter_map(|own| own.launch).chain([self.agents.launch]);
        if launches.into_iter().any(|launch| launch == Launch::Elsewhere) {
            return value("launch", "elsewhere".into(), "must be here with clock stepped, which runs in one process");
        }
        for (field, ms) in self.stepped.and_then(|stepped| stepped.compute).into_iter().flat_map(|compute| {
            [
                ("stepped.compute.pose_ms", compute.pose_ms),
                ("stepped.compute.map_ms", compute.map_ms),
                ("stepped.compute.fuse_ms", compute.fuse_ms),
            ]
        }) {
            if !(0.0..=60_000.0).contains(&ms) {
                return value(field, ms.to_string(), "must be 0 to 60000");
            }
        }
        Ok(())
    }
}

fn wrong(path: &Path, field: &'static str, found: String, rule: &'static str) -> ScenarioError {
    ScenarioError::Value { path: path.into(), field, found, rule }
}
