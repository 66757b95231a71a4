//! Pool of shared memory for the large messages of a process.
//!
//! A message in shared memory crosses sockets as a descriptor of some hundred bytes, through the router and to every
//! receiver that is attached to shared memory; zenoh copies it for all others. A message for which the pool has no
//! room, or whose router is not attached, takes the socket; both are counted ([`SharedMemoryUse`]).

use std::sync::Arc;

use bytes::Bytes;
use protocol::wire::Encoded;
use zenoh::bytes::ZBytes;
use zenoh::shm::{
    Defragment, GarbageCollect, PosixShmProviderBackend, ShmProvider, ShmProviderBuilder, ZShmMut,
};
use zenoh::{Session, Wait};

use super::message_stats::SharedMemoryUse;
use super::{BusError, MessageStats, SharedMemory};
use crate::Result;

/// Bodies of fewer bytes take the socket.
const SMALL_BYTES: usize = 16 << 10;
/// Folder in which the system keeps shared memory.
const FOLDER: &str = "/dev/shm";

/// The pool of a process; by default none: all messages take the socket. Clones share it.
#[derive(Clone, Default)]
pub(super) struct SharedPool(Option<Arc<ShmPool>>);

struct ShmPool {
    provider: ShmProvider<PosixShmProviderBackend>,
    session: Session,
    stats: MessageStats,
}

impl SharedPool {
    /// The pool for the messages of `session`; none without bytes.
    ///
    /// # Errors
    /// [`BusError::SharedMemory`] when the system has too little; [`BusError::Zenoh`] when it gives none.
    pub(super) fn open(
        session: &Session,
        memory: SharedMemory,
        stats: &MessageStats,
    ) -> Result<Self> {
        let SharedMemory::Pool(bytes @ 1..) = memory else {
            return Ok(Self::default());
        };
        check_room(bytes)?;
        let provider = ShmProviderBuilder::default_backend(bytes).wait();
        let provider =
            provider.map_err(|cause| BusError::zenoh("making a pool of shared memory", &cause))?;
        Ok(Self(Some(Arc::new(ShmPool {
            provider,
            session: session.clone(),
            stats: stats.clone(),
        }))))
    }

    /// Head and body concatenated; a large body is copied into the pool, others are not copied.
    pub(super) fn payload(&self, encoded: Encoded) -> ZBytes {
        let Encoded { head, body } = encoded;
        let mut writer = ZBytes::writer();
        writer.append(head.into());
        if !body.is_empty() {
            match self.shared(body.as_ref()) {
                Some(shared) => writer.append(shared.into()),
                None => writer.append(Bytes::from_owner(body).into()),
            }
        }
        writer.finish()
    }

    /// A copy of a large body in the pool.
    fn shared(&self, body: &[u8]) -> Option<ZShmMut> {
        let pool = self.0.as_deref().filter(|_| body.len() >= SMALL_BYTES)?;
        let info = pool.session.info();
        if !info.transports().wait().any(|transport| transport.is_shm()) {
            pool.stats.shared(SharedMemoryUse::RouterNotAttached);
            return None;
        }
        // Without waiting: a receiver that holds many messages must not delay the others.
        let place = pool
            .provider
            .alloc(body.len())
            .with_policy::<Defragment<GarbageCollect>>()
            .wait();
        let Ok(mut place) = place else {
            pool.stats.shared(SharedMemoryUse::PoolFull);
            return None;
        };
        place.as_mut().copy_from_slice(body);
        pool.stats.shared(SharedMemoryUse::Carried);
        Some(place)
    }
}

/// Checks that the system has room for pools of `bytes` together: a segment is made without its memory, and a process
/// is killed when it writes where there is none.
///
/// # Errors
/// [`BusError::SharedMemory`] with the wanted and the free memory.
pub fn check_room(bytes: usize) -> Result<()> {
    // Elsewhere shared memory is not in a folder.
    let Ok(room) = rustix::fs::statvfs(FOLDER) else {
        return Ok(());
    };
    let free = room.f_bavail.saturating_mul(room.f_frsize);
    if u64::try_from(bytes).is_ok_and(|bytes| bytes <= free) {
        return Ok(());
    }
    let (wanted, free) = (bytes >> 20, free >> 20);
    let problem = format!("{wanted} MiB of shared memory: {free} MiB");
    Err(BusError::SharedMemory(problem))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pool_larger_than_the_memory_is_refused() {
        let error = check_room(usize::MAX).unwrap_err().to_string();
        assert!(
            error.contains("shared memory") && error.contains("MiB"),
            "{error}"
        );
        check_room(1 << 20).unwrap();
    }
}
