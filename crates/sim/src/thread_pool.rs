//! Threads that step robots.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};

use crate::BackendBuildError;

/// Pools in use, by their number of threads.
static POOLS: Mutex<BTreeMap<usize, Weak<rayon::ThreadPool>>> = Mutex::new(BTreeMap::new());

/// Returns the pool of threads that step robots; 0 means one per core.
///
/// All simulations of a process with the same number of threads share one pool. A server with hundreds of leases would
/// otherwise have hundreds of pools.
pub(crate) fn thread_pool(threads: usize) -> Result<Arc<rayon::ThreadPool>, BackendBuildError> {
    let threads = match threads {
        0 => std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
        threads => threads,
    };
    let mut pools = POOLS.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(pool) = pools.get(&threads).and_then(Weak::upgrade) {
        return Ok(pool);
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = Arc::new(pool.map_err(|source| BackendBuildError::Threads { threads, source })?);
    pools.insert(threads, Arc::downgrade(&pool));
    Ok(pool)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn simulations_with_the_same_number_of_threads_share_a_pool() {
        let first = thread_pool(3).expect("three threads");
        assert!(Arc::ptr_eq(&first, &thread_pool(3).expect("three threads")));
        assert!(!Arc::ptr_eq(&first, &thread_pool(2).expect("two threads")));
    }
}
