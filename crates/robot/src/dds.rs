//! The robot's DDS topics. The only module that uses RustDDS.
//!
//! Readers and writers carry payloads, header and body, as [`twinstep_unitree::encode`] makes them: what is received is
//! recorded byte by byte. The quality of service is that of the vendor's SDK: readers are best-effort, writers reliable.

use std::convert::Infallible;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::task::{Wake, Waker};
use std::thread::Thread;

use rustdds::bytes::Bytes;
use rustdds::no_key::{DataWriter, Decode, DefaultDecoder, DeserializerAdapter, SerializerAdapter, SimpleDataReader};
use rustdds::policy::{History, Reliability};
use rustdds::{
    DomainParticipant, DomainParticipantBuilder, Duration, Publisher, QosPolicies, QosPolicyBuilder, RTPSEntity,
    RepresentationIdentifier, Subscriber, TopicKind,
};

use crate::command_datagram::WriterGuid;
use crate::real_time_thread;

/// A topic and the type of its messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Topic {
    /// Name of the topic.
    pub name: &'static str,
    /// Name of the type in the vendor's IDL.
    pub type_name: &'static str,
}

/// Commands to the motors.
pub const LOW_CMD: Topic = Topic { name: "rt/lowcmd", type_name: "unitree_go::msg::dds_::LowCmd_" };
/// State of motors, battery, IMU and remote control.
pub const LOW_STATE: Topic = Topic { name: "rt/lowstate", type_name: "unitree_go::msg::dds_::LowState_" };
/// State of the built-in controller.
pub const SPORT_MODE_STATE: Topic =
    Topic { name: "rt/sportmodestate", type_name: "unitree_go::msg::dds_::SportModeState_" };
/// Requests to the service that selects the built-in controller.
pub const MOTION_SWITCHER_REQUEST: Topic =
    Topic { name: "rt/api/motion_switcher/request", type_name: "unitree_api::msg::dds_::Request_" };
/// Its responses.
pub const MOTION_SWITCHER_RESPONSE: Topic =
    Topic { name: "rt/api/motion_switcher/response", type_name: "unitree_api::msg::dds_::Response_" };
/// Requests to the built-in controller.
pub const SPORT_REQUEST: Topic = Topic { name: "rt/api/sport/request", type_name: "unitree_api::msg::dds_::Request_" };
/// Its responses.
pub const SPORT_RESPONSE: Topic =
    Topic { name: "rt/api/sport/response", type_name: "unitree_api::msg::dds_::Response_" };

/// A DDS domain cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DdsError {
    /// The domain number is too large.
    #[error("`domain` = {0} is not allowed: 0 to 232; the robot uses 0, the vendor's simulator 1")]
    Domain(u16),
    /// The domain could not be joined.
    #[error("cannot join DDS domain {domain}: {reason}")]
    Join {
        /// The domain.
        domain: u16,
        /// Error of RustDDS.
        reason: String,
    },
    /// A reader or writer could not be created.
    #[error("cannot use the topic `{topic}`: {reason}")]
    Topic {
        /// The topic.
        topic: &'static str,
        /// Error of RustDDS.
        reason: String,
    },
}

/// Participant of a DDS domain. Clones are the same participant.
#[derive(Clone)]
pub struct Dds {
    /// Address of the network interface.
    address: IpAddr,
    participant: DomainParticipant,
    publisher: Publisher,
    subscriber: Subscriber,
}

impl Dds {
    /// Joins a domain on the network interface with `address`. The threads of the participant have real-time scheduling.
    pub fn join(domain: u16, address: IpAddr) -> Result<Self, DdsError> {
        if domain > 232 {
            return Err(DdsError::Domain(domain));
        }
        let failed = |reason: String| DdsError::Join { domain, reason };
        let joining = real_time_thread::spawn("dds", move || Self::create(domain, address));
        let joined = joining.map_err(|error| failed(error.to_string()))?.join();
        joined.unwrap_or_else(|_| Err(failed("RustDDS panicked".to_owned())))
    }

    fn create(domain: u16, address: IpAddr) -> Result<Self, DdsError> {
        let failed = |reason: String| DdsError::Join { domain, reason };
        let participant = DomainParticipantBuilder::new(domain)
            .with_only_networks([address])
            .build()
            .map_err(|error| failed(error.to_string()))?;
        let qos = QosPolicyBuilder::new().build();
        let publisher = participant.create_publisher(&qos).map_err(|error| failed(error.to_string()))?;
        let subscriber = participant.create_subscriber(&qos).map_err(|error| failed(error.to_string()))?;
        Ok(Self { address, participant, publisher, subscriber })
    }

    /// Returns the address of the network interface.
    pub fn address(&self) -> IpAddr {
        self.address
    }

    /// Returns a reader of `topic`, which wakes `reader_thread` when a message arrives.
    pub fn reader(&self, topic: Topic, reader_thread: Thread) -> Result<Reader, DdsError> {
        let failed = |reason: String| DdsError::Topic { topic: topic.name, reason };
        // Deep enough for the messages of a pause of this process: all are recorded.
        let qos = qos(Reliability::BestEffort, 64);
        let handle = self.topic(topic, &qos)?;
        let reader = self
            .subscriber
            .create_simple_datareader_no_key::<Payload, Raw>(&handle, Some(qos))
            .map_err(|error| failed(error.to_string()))?;
        Ok(Reader { reader, waker: Waker::from(Arc::new(Unpark(reader_thread))) })
    }

    /// Returns a writer of `topic`. From now on others discover it. `depth` is the number of messages that may wait to be sent:
    /// one for commands, of which only the newest is true.
    pub fn writer(&self, topic: Topic, depth: i32) -> Result<Writer, DdsError> {
        let failed = |reason: String| DdsError::Topic { topic: topic.name, reason };
        // A write never waits for its readers: with `KeepLast` a newer message replaces the older one.
        let qos = qos(Reliability::Reliable { max_blocking_time: Duration::ZERO }, depth);
        let handle = self.topic(topic, &qos)?;
        let writer = self
            .publisher
            .create_datawriter_no_key::<Payload, Raw>(&handle, Some(qos))
            .map_err(|error| failed(error.to_string()))?;
        Ok(Writer { writer, topic })
    }

    /// Returns the number of writers of `topic` in other participants.
    pub fn foreign_writers(&self, topic: Topic) -> usize {
        let writers = self.participant.discovered_writers();
        writers.iter().filter(|writer| writer.publication_topic_data.topic_name() == topic.name).count()
    }

    /// Returns the addresses of the readers of `topic` in other participants, in a fixed order: for each reader those in the
    /// network of the interface, or all that it announces if none is. Those at an address of `robot`, the writer of the states,
    /// are first: if the list is shortened, the motors stay in it. Readers of other robots are left out: their participant
    /// writes states too, or one at their address does.
    pub fn readers(&self, topic: Topic, robot: Option<WriterGuid>) -> Vec<SocketAddr> {
        let own = self.participant.guid().prefix;
        let others = self.other_robots(robot);
        let readers = self.participant.discovered_readers();
        let of_topic = readers.iter().filter(|reader| reader.subscription_topic_data.topic_name() == topic.name);
        let mut addresses: Vec<SocketAddr> = of_topic
            .map(|reader| &reader.reader_proxy)
            .filter(|reader| reader.remote_reader_guid.prefix != own)
            .filter(|reader| !others.prefixes.contains(&reader.remote_reader_guid.to_bytes()[..12].to_vec()))
            .flat_map(|reader| {
                let unicast = addresses(&reader.unicast_locator_list);
                let multicast = addresses(&reader.multicast_locator_list);
                nearest(if unicast.is_empty() { multicast } else { unicast }, self.address)
            })
            .filter(|address| !others.addresses.contains(&address.ip()))
            .collect();
        addresses.sort_unstable_by_key(|address| (!others.of_robot.contains(&address.ip()), *address));
        addresses.dedup();
        addresses
    }

    /// Returns the participants that write states, except that of `robot`, and their addresses, except those of `robot`.
    fn other_robots(&self, robot: Option<WriterGuid>) -> OtherRobots {
        let Some(robot) = robot else { return OtherRobots::default() };
        let writers = self.participant.discovered_writers();
        let of_states = writers.iter().filter(|writer| writer.publication_topic_data.topic_name() == LOW_STATE.name);
        let (own, others): (Vec<_>, Vec<_>) = of_states
            .map(|writer| &writer.writer_proxy)
            .map(|writer| {
                (writer.remote_writer_guid.to_bytes()[..12].to_vec(), addresses(&writer.unicast_locator_list))
            })
            .partition(|(prefix, _)| prefix[..] == robot[..12]);
        let ips = |writers: &[(Vec<u8>, Vec<SocketAddr>)]| -> Vec<IpAddr> {
            writers.iter().flat_map(|(_, addresses)| addresses).map(SocketAddr::ip).collect()
        };
        let of_own = ips(&own);
        OtherRobots {
            addresses: ips(&others).into_iter().filter(|address| !of_own.contains(address)).collect(),
            of_robot: of_own,
            prefixes: others.into_iter().map(|(prefix, _)| prefix).collect(),
        }
    }

    fn topic(&self, topic: Topic, qos: &QosPolicies) -> Result<rustdds::Topic, DdsError> {
        self.participant
            .create_topic(topic.name.to_owned(), topic.type_name.to_owned(), qos, TopicKind::NoKey)
            .map_err(|error| DdsError::Topic { topic: topic.name, reason: error.to_string() })
    }
}

/// Participants and addresses of robots that are not the one that is commanded, and its own addresses.
#[derive(Default)]
struct OtherRobots {
    prefixes: Vec<Vec<u8>>,
    addresses: Vec<IpAddr>,
    /// Addresses of the one that is commanded.
    of_robot: Vec<IpAddr>,
}

/// Returns the IPv4 addresses of locators.
fn addresses<L: Copy + Into<SocketAddr>>(locators: &[L]) -> Vec<SocketAddr> {
    let all = locators.iter().map(|locator| (*locator).into());
    all.filter(|address| address.is_ipv4() && address.port() != 0).collect()
}

/// Returns those addresses that share the first three bytes with `interface`, or all if none does.
fn nearest(addresses: Vec<SocketAddr>, interface: IpAddr) -> Vec<SocketAddr> {
    let network = |address: IpAddr| match address {
        IpAddr::V4(address) => Some([address.octets()[0], address.octets()[1], address.octets()[2]]),
        IpAddr::V6(_) => None,
    };
    let near: Vec<SocketAddr> =
        addresses.iter().copied().filter(|address| network(address.ip()) == network(interface)).collect();
    if near.is_empty() { addresses } else { near }
}

fn qos(reliability: Reliability, depth: i32) -> QosPolicies {
    QosPolicyBuilder::new().reliability(reliability).history(History::KeepLast { depth }).build()
}

/// Reader of a topic.
pub struct Reader {
    reader: SimpleDataReader<Payload, Raw>,
    waker: Waker,
}

impl Reader {
    /// Returns the next payload, or `None` if there is none: then the next one to arrive wakes the reader's thread.
    pub fn take(&self) -> Option<Vec<u8>> {
        self.take_with_writer().map(|(payload, _)| payload)
    }

    /// Returns the next payload with the id of its writer, as [`Reader::take`] does.
    pub fn take_with_writer(&self) -> Option<(Vec<u8>, WriterGuid)> {
        self.reader.drain_read_notifications();
        // The waker is set before the last look, so that no message arrives in between unnoticed.
        self.next().or_else(|| {
            self.reader.set_waker(Some(self.waker.clone()));
            self.next()
        })
    }

    fn next(&self) -> Option<(Vec<u8>, WriterGuid)> {
        loop {
            match self.reader.try_take_one() {
                Ok(message) => return message.map(|message| (message.sample.0, message.writer_guid.to_bytes())),
                // The message that cannot be decoded is gone; the next one may be whole.
                Err(error) => tracing::debug!(%error, "message dropped"),
            }
        }
    }
}

/// Writer of a topic.
pub struct Writer {
    writer: DataWriter<Payload, Raw>,
    topic: Topic,
}

impl Writer {
    /// Returns the id of the writer.
    pub fn guid(&self) -> WriterGuid {
        self.writer.guid().to_bytes()
    }

    /// Sends a payload. Never waits.
    pub fn write(&self, payload: Vec<u8>) {
        if let Err(error) = self.writer.write(Payload(payload), None) {
            tracing::warn!(topic = self.topic.name, %error, "message not sent");
        }
    }
}

/// Wakes a thread that is parked.
struct Unpark(Thread);

impl Wake for Unpark {
    fn wake(self: Arc<Self>) {
        self.0.unpark();
    }
}

/// Header and body of a message.
struct Payload(Vec<u8>);

/// Takes payloads as they are.
#[derive(Clone)]
struct Raw;

/// Size of the header of a payload [bytes].
const HEADER: usize = 4;

impl DeserializerAdapter<Payload> for Raw {
    type Error = Infallible;
    type Decoded = Payload;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        const ENCODINGS: [RepresentationIdentifier; 2] =
            [RepresentationIdentifier::CDR_LE, RepresentationIdentifier::CDR_BE];
        &ENCODINGS
    }

    fn transform_decoded(decoded: Payload) -> Payload {
        decoded
    }
}

impl DefaultDecoder<Payload> for Raw {
    type Decoder = Self;
    const DECODER: Self = Raw;
}

impl Decode<'_, Payload> for Raw {
    type Error = Infallible;

    fn decode_bytes(self, body: &[u8], encoding: RepresentationIdentifier) -> Result<Payload, Infallible> {
        let little_endian = u8::from(encoding == RepresentationIdentifier::CDR_LE);
        Ok(Payload([&[0, little_endian, 0, 0][..], body].concat()))
    }
}

impl SerializerAdapter<Payload> for Raw {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(payload: &Payload) -> Result<Bytes, Infallible> {
        Ok(Bytes::copy_from_slice(&payload.0[HEADER..]))
    }
}
