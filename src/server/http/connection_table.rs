//! Which connections are open: their number, in total and for each address, and which was idle the longest.

use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use metrics::counter;
use tokio::sync::Notify;

use foreframe_core::metric_names;

/// The limits of a [`ConnectionTable`].
pub(super) struct ConnectionLimits {
    pub(super) total: usize,
    /// The limit of one IPv4 address, or one /64 network of IPv6.
    pub(super) per_address: usize,
    /// How long a connection must have been idle to give its place to another.
    pub(super) evict_after: Duration,
}

/// The open connections. Time is an argument.
pub(super) struct ConnectionTable {
    limits: ConnectionLimits,
    open: Mutex<OpenConnections>,
}

#[derive(Default)]
struct OpenConnections {
    by_id: HashMap<u64, OpenConnection>,
    next_id: u64,
}

struct OpenConnection {
    address: IpAddr,
    /// Requests that are being answered.
    busy: usize,
    idle_since: Instant,
    evicted: Arc<Notify>,
}

impl ConnectionTable {
    pub(super) fn new(limits: ConnectionLimits) -> Self {
        Self {
            limits,
            open: Mutex::default(),
        }
    }

    /// A place for a connection from that address. If there is none, the connection that was idle the longest gives its
    /// place, if that was long enough; `None` if there is no such connection.
    pub(super) fn admit(self: &Arc<Self>, address: IpAddr, now: Instant) -> Option<Arc<ConnectionPlace>> {
        let (mut open, address) = (self.open(), counted(address));
        let of_address = open.by_id.values().filter(|open| open.address == address).count();
        if of_address >= self.limits.per_address {
            open.evict_idlest(Some(address), now, self.limits.evict_after)?;
        } else if open.by_id.len() >= self.limits.total {
            open.evict_idlest(None, now, self.limits.evict_after)?;
        }
        let (id, evicted) = (open.next_id, Arc::new(Notify::new()));
        open.next_id += 1;
        let connection = OpenConnection {
            address,
            busy: 0,
            idle_since: now,
            evicted: Arc::clone(&evicted),
        };
        open.by_id.insert(id, connection);
        let table = Arc::clone(self);
        Some(Arc::new(ConnectionPlace { table, id, evicted }))
    }

    fn open(&self) -> MutexGuard<'_, OpenConnections> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl OpenConnections {
    fn evict_idlest(&mut self, of: Option<IpAddr>, now: Instant, after: Duration) -> Option<()> {
        let candidates = self.by_id.iter().filter(|(_, connection)| {
            let is_of_address = of.is_none_or(|address| address == connection.address);
            is_of_address && connection.busy == 0 && now.saturating_duration_since(connection.idle_since) >= after
        });
        let (&id, _) = candidates.min_by_key(|(_, connection)| connection.idle_since)?;
        self.by_id.remove(&id)?.evicted.notify_one();
        counter!(metric_names::HTTP_CONNECTIONS_EVICTED).increment(1);
        Some(())
    }
}

/// The address for counting: a client with IPv6 has a whole /64 network.
fn counted(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => Ipv6Addr::from_bits(address.to_bits() & (u128::MAX << 64)).into(),
        address @ IpAddr::V4(_) => address,
    }
}

/// The place of one connection, free again on drop.
pub(in crate::server) struct ConnectionPlace {
    table: Arc<ConnectionTable>,
    id: u64,
    evicted: Arc<Notify>,
}

impl ConnectionPlace {
    /// Marks the connection as busy until the result is dropped.
    pub(super) fn begin(self: &Arc<Self>) -> BusyConnection {
        if let Some(connection) = self.table.open().by_id.get_mut(&self.id) {
            connection.busy += 1;
        }
        BusyConnection {
            place: Arc::clone(self),
            is_kept: false,
        }
    }

    /// Completes when the connection has lost its place to another.
    pub(super) fn evicted(&self) -> impl Future<Output = ()> + use<> {
        let evicted = Arc::clone(&self.evicted);
        async move { evicted.notified().await }
    }

    pub(super) fn is_evicted(&self) -> bool {
        !self.table.open().by_id.contains_key(&self.id)
    }
}

impl Drop for ConnectionPlace {
    fn drop(&mut self) {
        self.table.open().by_id.remove(&self.id);
    }
}

/// A connection that is being used, and so is not evicted.
pub(super) struct BusyConnection {
    place: Arc<ConnectionPlace>,
    is_kept: bool,
}

impl BusyConnection {
    /// The connection stays busy until its end; so there is nothing left to hold.
    pub(super) fn keep(mut self) -> Option<Self> {
        self.is_kept = true;
        None
    }
}

impl Drop for BusyConnection {
    fn drop(&mut self) {
        if self.is_kept {
            return;
        }
        if let Some(connection) = self.place.table.open().by_id.get_mut(&self.place.id) {
            connection.busy = connection.busy.saturating_sub(1);
            connection.idle_since = Instant::now();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use futures_util::FutureExt as _;

    use super::*;

    fn table(total: usize, per_address: usize) -> Arc<ConnectionTable> {
        Arc::new(ConnectionTable::new(ConnectionLimits {
            total,
            per_address,
            evict_after: Duration::from_secs(1),
        }))
    }

    fn address(last: u8) -> IpAddr {
        Ipv4Addr::new(10, 0, 0, last).into()
    }

    #[test]
    fn a_full_table_evicts_the_idlest_connection_that_is_not_busy() {
        let (table, start) = (table(3, 3), Instant::now());
        let after = |seconds| start + Duration::from_secs(seconds);
        let busy = table.admit(address(1), start).unwrap();
        let _request = busy.begin();
        let idle = table.admit(address(2), after(1)).unwrap();
        let fresh = table.admit(address(3), after(2)).unwrap();
        let _next = table.admit(address(4), after(3)).unwrap();
        assert!(idle.is_evicted() && idle.evicted().now_or_never().is_some());
        assert!(!busy.is_evicted() && !fresh.is_evicted());
    }

    #[test]
    fn a_connection_that_was_just_used_is_not_evicted() {
        let (table, start) = (table(1, 1), Instant::now());
        let used = table.admit(address(1), start).unwrap();
        assert!(table.admit(address(2), start + Duration::from_millis(900)).is_none());
        drop(used);
        assert!(table.admit(address(2), start).is_some());
    }

    #[test]
    fn an_address_over_its_limit_evicts_only_its_own() {
        let (table, start) = (table(10, 2), Instant::now());
        let later = start + Duration::from_secs(9);
        let other = table.admit(address(1), start).unwrap();
        let own = [(); 2].map(|()| table.admit(address(2), start).unwrap());
        let third = table.admit(address(2), later).unwrap();
        assert!(!other.is_evicted() && own.iter().filter(|place| place.is_evicted()).count() == 1);
        let _requests = [third.begin(), own[0].begin(), own[1].begin()];
        assert!(table.admit(address(2), later).is_none() && table.admit(address(3), later).is_some());
    }

    #[test]
    fn a_network_of_ipv6_counts_as_one_address() {
        let of = |text: &str| counted(text.parse().unwrap());
        assert_eq!(of("2001:db8::1"), of("2001:db8::ffff:1"));
        assert_ne!(of("2001:db8::1"), of("2001:db8:0:1::1"));
        assert_eq!(of("::ffff:10.0.0.1"), address(1));
    }
}
