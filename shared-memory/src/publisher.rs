//! The writer of estimates: loan, write, send.

use core::fmt::Display;
use std::sync::Arc;

use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher;
use iceoryx2::prelude::ipc;
use results::{EstimateRecord, Names};

use super::layout::{self, Header, Stamp};
use super::services::{Services, join};
use super::{PublishError, now_ns};

/// The writer's end.
pub struct Publisher {
    notifier: Notifier<ipc::Service>,
    publisher: publisher::Publisher<ipc::Service, [u32], Header>,
    services: Services,
    name: Arc<str>,
    started_ns: u64,
    /// The names of the records, as they were last.
    text: (Arc<Names>, layout::Text),
}

impl Publisher {
    /// Join a service, or create it, as the publisher `name` of estimates with these names, and clear away what dead
    /// processes have left.
    ///
    /// # Errors
    /// [`PublishError::Name`] or [`PublishError::Join`].
    pub fn try_new(service: &str, name: &str, names: &Arc<Names>) -> Result<Self, PublishError> {
        let is_name = (1..=127).contains(&name.len()) && name.chars().all(|c| (' '..='~').contains(&c));
        if !is_name {
            return Err(PublishError::Name { name: name.to_owned() });
        }
        let services = Services::try_join(service, name)?;
        let text = layout::Text::of(name, names);
        let publisher = services.estimates.publisher_builder().initial_max_slice_len(text.words_of(names));
        let publisher = publisher.create().map_err(|e| join(service, "publisher", &e))?;
        let notifier = services.news.notifier_builder().create().map_err(|e| join(service, "notifier", &e))?;
        let (text, started_ns) = ((names.clone(), text), now_ns());
        let this = Self { notifier, publisher, services, name: name.into(), started_ns, text };
        this.announce(); // readers connect now, before the first estimate
        Ok(this)
    }

    /// Write a record into shared memory, stamp it, and wake the readers. Never waits for them.
    ///
    /// # Errors
    /// [`PublishError::Send`].
    pub fn publish(&mut self, record: &EstimateRecord) -> Result<(), PublishError> {
        self.send(record)?;
        self.announce();
        Ok(())
    }

    /// Write a record into shared memory and stamp it; [`Publisher::announce`] is to follow, once for several records.
    ///
    /// # Errors
    /// [`PublishError::Send`].
    pub fn send(&mut self, record: &EstimateRecord) -> Result<(), PublishError> {
        let wrong = |reason: &dyn Display| PublishError::Send {
            service: self.services.name.clone(),
            sequence: record.sequence,
            reason: reason.to_string(),
        };
        let stamp = Stamp { publisher: self.name.clone(), started_ns: self.started_ns, published_ns: now_ns() };
        if !Arc::ptr_eq(&self.text.0, &record.names) {
            self.text = (record.names.clone(), layout::Text::of(&self.name, &record.names));
        }
        let (header, payload) = layout::encode(record, &stamp, &self.text.1);
        let mut sample = self.publisher.loan_slice_uninit(payload.len()).map_err(|e| wrong(&e))?;
        *sample.user_header_mut() = header;
        sample.write_from_slice(&payload).send().map_err(|e| wrong(&e))?;
        Ok(())
    }

    /// Wake the readers. One that cannot be woken looks for itself when its wait ends: no error of the writer's.
    pub fn announce(&self) {
        let _ = self.notifier.notify();
    }
}

#[cfg(test)]
mod tests {
    use core::time::Duration;
    use std::time::Instant;

    use super::*;
    use crate::{Published, Subscriber};

    const SOON: Duration = Duration::from_secs(60);

    fn name(test: &str) -> String {
        format!("orbitcal/test/{}/{test}", std::process::id())
    }

    fn record(frames: u32) -> EstimateRecord {
        EstimateRecord { frames, mean: vec![frames as f32; 20], ..EstimateRecord::example(20, 10) }
    }

    fn publisher(test: &str) -> Publisher {
        Publisher::try_new(&name(test), "a test", &record(0).names).unwrap()
    }

    fn frames(heard: &[Published]) -> Vec<u32> {
        heard.iter().map(|published| published.record.frames).collect()
    }

    #[test]
    fn a_reader_gets_what_was_written() {
        let mut subscriber = Subscriber::try_new(&name("same")).unwrap();
        let mut publisher = publisher("same");
        let before = now_ns();
        publisher.publish(&record(7)).unwrap();
        let heard = subscriber.wait(SOON).unwrap();
        assert_eq!((heard.len(), &heard[0].record), (1, &record(7)));
        let stamp = &heard[0].stamp;
        assert_eq!(&*stamp.publisher, "a test");
        assert!(stamp.started_ns <= before && before <= stamp.published_ns);
    }

    #[test]
    fn a_late_reader_gets_the_last_sixteen() {
        let mut publisher = publisher("late");
        (1..=40).for_each(|i| publisher.publish(&record(i)).unwrap());
        let mut subscriber = Subscriber::try_new(&name("late")).unwrap();
        publisher.publish(&record(41)).unwrap();
        assert_eq!(frames(&subscriber.wait(SOON).unwrap()), (25..=41).collect::<Vec<_>>());
    }

    #[test]
    fn a_reader_that_sleeps_loses_the_oldest_and_the_writer_does_not_wait() {
        let mut subscriber = Subscriber::try_new(&name("slow")).unwrap();
        let mut publisher = publisher("slow");
        (1..=1000).for_each(|i| publisher.publish(&record(i)).unwrap());
        assert_eq!(frames(&subscriber.wait(SOON).unwrap()), (745..=1000).collect::<Vec<_>>());
    }

    #[test]
    fn a_reader_outlives_its_writers() {
        let mut subscriber = Subscriber::try_new(&name("again")).unwrap();
        let mut starts = Vec::new();
        for i in 1..=5 {
            let mut publisher = publisher("again");
            subscriber.wait(Duration::ZERO).unwrap(); // as its wake-up would
            publisher.publish(&record(i)).unwrap();
            drop(publisher);
            let heard = subscriber.wait(SOON).unwrap();
            assert_eq!(frames(&heard), [i]);
            starts.push(heard[0].stamp.started_ns);
        }
        assert!(starts.is_sorted_by(|a, b| a < b), "{starts:?}");
    }

    #[test]
    fn waiting_ends_in_time() {
        let mut subscriber = Subscriber::try_new(&name("idle")).unwrap();
        let start = Instant::now();
        assert!(subscriber.wait(Duration::from_millis(30)).unwrap().is_empty());
        assert!(start.elapsed() >= Duration::from_millis(30), "{:?}", start.elapsed());
    }

    #[test]
    fn a_name_that_is_none_is_refused_in_one_line() {
        let said = |service, name| Publisher::try_new(service, name, &record(0).names).err().unwrap().to_string();
        let expected = "expected a name of 1 to 127 printable ASCII characters, not beginning with iox2://";
        assert_eq!(said("", "a test"), format!("\"\": {expected}"));
        assert_eq!(said("orbitcal/test", "two\nlines"), format!("\"two\\nlines\": {expected}"));
    }
}
