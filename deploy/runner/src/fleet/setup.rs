//! Setup of a fleet in simulation time.

use anyhow::Result;
use ego_fuser_offline::evaluation::{AgentPool, EmulatedLink, Setup};

use super::Fleet;

impl Fleet {
    /// Setup in simulation time, with the compute times of the scenario.
    ///
    /// # Errors
    /// An error when the link cannot be read.
    pub(crate) fn setup(&self) -> Result<Setup> {
        let scenario = &self.scenario;
        // Without a link in the scenario messages take the ideal one.
        let link = scenario.link.clone().unwrap_or_default();
        let own = scenario.vehicles.iter();
        let vehicles = own.map(|(cav, own)| (cav.clone(), own.over(&scenario.agents)));
        let compute = scenario.stepped.and_then(|stepped| stepped.compute);
        let pool = std::iter::once(&self.ego).chain(self.neighbours());
        Ok(Setup {
            models: scenario.models.clone(),
            method: Some(scenario.method),
            agents: scenario.agents.clone(),
            vehicles: vehicles.collect(),
            ego: scenario.ego.clone(),
            link: Some(EmulatedLink::open(&link.model, link.seed)?),
            compute: compute.unwrap_or_default(),
            protocol: Some(self.protocol.clone()),
            pool: AgentPool::Named(pool.cloned().collect()),
            seek: scenario.scene.seek,
            frames: self.ticks,
            lidar_variant: scenario.scene.variant.clone(),
            ..Setup::default()
        })
    }
}
