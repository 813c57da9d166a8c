//! What is read from the store once for many clients.

use std::time::{Duration, Instant};

use tokio::sync::Mutex;

/// What was read last, and when; `None` if it failed.
pub(super) struct SharedReading<T> {
    last: Mutex<Option<(Instant, Option<T>)>>,
}

impl<T> Default for SharedReading<T> {
    fn default() -> Self {
        Self { last: Mutex::new(None) }
    }
}

impl<T: Copy> SharedReading<T> {
    /// What was read last, unless it is older; else what `read` gives, which runs once at a time. `None` if the reading failed.
    pub(super) async fn not_older(&self, than: Duration, read: impl Future<Output = Option<T>>) -> Option<T> {
        let mut last = self.last.lock().await;
        if let Some((at, value)) = *last
            && at.elapsed() < than
        {
            return value;
        }
        let value = read.await;
        *last = Some((Instant::now(), value));
        value
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn it_is_read_once_for_all_who_ask_soon() {
        let reading = SharedReading::default();
        let hour = Duration::from_hours(1);
        assert_eq!(reading.not_older(hour, async { Some(1) }).await, Some(1));
        assert_eq!(reading.not_older(hour, async { Some(2) }).await, Some(1));
        assert_eq!(reading.not_older(Duration::ZERO, async { None }).await, None);
        assert_eq!(reading.not_older(hour, async { Some(3) }).await, None);
        assert_eq!(reading.not_older(Duration::ZERO, async { Some(4) }).await, Some(4));
    }
}
