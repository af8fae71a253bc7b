//! Engines and trainers that implement the protocol without the library, so that they can send invalid messages.

use std::fs::File;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use bytemuck::{Pod, Zeroable};
use endless_gym::batch::{Block, LAYOUT_VERSION};
use endless_gym::service::{Namespace, Observer, ServiceSpecification};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::header::publish_subscribe::Header;

use super::place::Place;

#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(transparent)]
struct PayloadBlock(Block);

// SAFETY: a block is 64 plain bytes.
unsafe impl ZeroCopySend for PayloadBlock {
    unsafe fn type_name() -> &'static str {
        "endless_gym::Block"
    }
}

#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[type_name("endless_gym::RequestHeader")]
#[repr(C)]
pub struct RequestHeader {
    pub layout_version: u32,
    pub kind: u32,
    pub incarnation: u64,
    pub trainer: u64,
    pub request: u64,
    pub seed: u64,
    pub env: u64,
    pub bytes: u64,
    pub process: u32,
    pub held: u32,
}

#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[type_name("endless_gym::ResponseHeader")]
#[repr(C)]
pub struct ResponseHeader {
    layout_version: u32,
    group: u32,
    incarnation: u64,
    step: u64,
    trainer: u64,
    request: u64,
    bytes: u64,
    status: u32,
    padding: u32,
}

fn node(namespace: &Namespace) -> Node<ipc::Service> {
    std::fs::create_dir_all(namespace.root()).unwrap();
    std::fs::set_permissions(namespace.root(), std::os::unix::fs::PermissionsExt::from_mode(0o700)).unwrap();
    let mut config = Config::default();
    config.global.set_root_path(&Path::new(namespace.root().to_str().unwrap().as_bytes()).unwrap());
    let file = namespace.root().join("prefix");
    if !file.exists() {
        std::fs::write(&file, format!("{}Alien_", namespace.prefix())).unwrap();
    }
    config.global.prefix = FileName::new(&std::fs::read(file).unwrap()).unwrap();
    NodeBuilder::new().config(&config).create().unwrap()
}

/// The name of a service of an engine.
fn service_name(specification: &ServiceSpecification, what: &str) -> ServiceName {
    let ServiceSpecification { service, incarnation, .. } = specification;
    ServiceName::new(&format!("endless-gym/{service}/{incarnation:016x}/{what}/0")).unwrap()
}

/// A trainer that can send any message.
pub struct Foreign {
    publisher: Publisher<ipc::Service, [PayloadBlock], RequestHeader>,
    subscriber: Subscriber<ipc::Service, [PayloadBlock], ResponseHeader>,
    pub specification: ServiceSpecification,
    _node: Node<ipc::Service>,
}

impl Foreign {
    /// The trainer of the engine `gym`, and the header of a request that resets all environments.
    pub fn of(place: &Place) -> (Self, RequestHeader) {
        let specification = place.trainer("gym").unwrap().specification().clone();
        let node = node(place.namespace());
        let name = |what| service_name(&specification, what);
        let blocks = specification.action.blocks();
        let act =
            node.service_builder(&name("act")).publish_subscribe::<[PayloadBlock]>().user_header::<RequestHeader>();
        let publisher = act.open().unwrap().publisher_builder().initial_max_slice_len(blocks).create().unwrap();
        let obs = node.service_builder(&name("obs")).publish_subscribe::<[PayloadBlock]>().user_header();
        let subscriber = obs.open().unwrap().subscriber_builder().create().unwrap();
        let (layout_version, incarnation) = (LAYOUT_VERSION, specification.incarnation);
        let header =
            RequestHeader { layout_version, kind: 2, incarnation, trainer: 42, request: 1, ..Default::default() };
        (Foreign { publisher, subscriber, specification, _node: node }, header)
    }

    pub fn blocks(&self) -> usize {
        self.specification.action.blocks()
    }

    /// A request with a payload of zeros.
    fn loan(&self, header: RequestHeader, blocks: usize) -> SampleMut<ipc::Service, [PayloadBlock], RequestHeader> {
        let zero = vec![PayloadBlock::zeroed(); blocks];
        let mut message = self.publisher.loan_slice_uninit(blocks).unwrap().write_from_slice(&zero);
        *message.user_header_mut() = header;
        message
    }

    /// Sends a request and returns the status and the text of the response; `None` if there is no response.
    pub fn ask(&self, header: RequestHeader, blocks: usize, fill: impl FnOnce(&mut [Block])) -> Option<(u32, String)> {
        let mut message = self.loan(header, blocks);
        fill(bytemuck::cast_slice_mut(message.payload_mut()));
        assert_eq!(message.send().unwrap(), 1);
        self.answer()
    }

    /// Sends a request, and overwrites its header and payload with `words` until the engine answers or 20 milliseconds
    /// have passed, long enough for the engine to read them several times.
    pub fn ask_while_changing(&self, header: RequestHeader, mut words: impl FnMut() -> u64) {
        let mut message = self.loan(header, self.blocks());
        let mut memory = SharedWords::of(message.user_header_mut());
        let mut payload = SharedWords::of(message.payload_mut());
        message.send().unwrap();
        let start = Instant::now();
        while start.elapsed() < Duration::from_millis(20) && self.subscriber.receive().unwrap().is_none() {
            // Keep the incarnation, since requests for another one are dropped.
            memory.change([0, 2, 3, 4, 5, 6, 7, 8][words() as usize % 8], words());
            for _ in 0..64 {
                payload.change(words() as usize, words());
            }
        }
    }

    fn answer(&self) -> Option<(u32, String)> {
        let start = Instant::now();
        while start.elapsed() < Duration::from_secs(1) {
            if let Some(answer) = self.subscriber.receive().unwrap() {
                let header = answer.user_header();
                assert_eq!((header.trainer, header.request), (42, 1));
                if header.status == 0 {
                    return Some((0, String::new()));
                }
                let payload: &[u8] = bytemuck::cast_slice(answer.payload());
                return Some((header.status, String::from_utf8_lossy(&payload[..header.bytes as usize]).into_owned()));
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        None
    }
}

/// Words in shared memory that another process reads at the same time.
pub struct SharedWords {
    first: *mut u64,
    count: usize,
}

impl SharedWords {
    fn of<T: ?Sized>(value: &mut T) -> Self {
        SharedWords { count: size_of_val(value) / size_of::<u64>(), first: std::ptr::from_mut(value).cast() }
    }

    /// Overwrites one of the words.
    pub fn change(&mut self, index: usize, word: u64) {
        // SAFETY: a header or payload is aligned to words, and mapped for writing as long as its publisher exists,
        // which the tests ensure.
        unsafe { self.first.add(index % self.count).write_volatile(word) };
    }
}

/// An engine of one group that can send any batch and does not answer requests.
pub struct Engine {
    observations: Publisher<ipc::Service, [PayloadBlock], ResponseHeader>,
    specification: ServiceSpecification,
    _parts: Box<dyn std::any::Any>,
}

/// A sent message in shared memory.
pub struct SentHeader {
    /// The whole user header.
    pub words: SharedWords,
    pub payload: SharedWords,
    header: *mut ResponseHeader,
    /// The payload's number of blocks in iceoryx2's header.
    length: *mut u64,
}

impl SentHeader {
    /// Changes group, step and number of blocks after the message was received.
    pub fn overwrite(&mut self, group: u32, step: u64, blocks: u64) {
        // SAFETY: the chunk is mapped as long as the publisher exists, which the tests ensure. Its receiver holds it,
        // so the publisher does not reuse it.
        unsafe {
            (&raw mut (*self.header).group).write_volatile(group);
            (&raw mut (*self.header).step).write_volatile(step);
            self.length.write_volatile(blocks);
        }
    }
}

/// The address of the number of elements in iceoryx2's header, whose fields are private: the last word with the value
/// `value`.
fn number_of_elements(header: &Header, value: usize) -> *mut u64 {
    let first = std::ptr::from_ref(header).cast::<u64>().cast_mut();
    let words = size_of::<Header>() / size_of::<u64>();
    // SAFETY: the header consists of that many initialised and aligned words.
    let found = (0..words).rev().find(|word| unsafe { first.add(*word).read() } == value as u64);
    first.wrapping_add(found.unwrap())
}

impl Engine {
    /// Publishes `specification` under the name `service`.
    pub fn new(namespace: &Namespace, service: &str, specification: &ServiceSpecification) -> Self {
        let node = node(namespace);
        let specification = ServiceSpecification { service: service.to_owned(), ..specification.clone() };
        let service = node
            .service_builder(&service_name(&specification, "obs"))
            .publish_subscribe::<[PayloadBlock]>()
            .user_header::<ResponseHeader>()
            .enable_safe_overflow(true)
            .history_size(0)
            .subscriber_max_buffer_size(1)
            .subscriber_max_borrowed_samples(specification.batches_held)
            .max_publishers(1)
            .max_subscribers(1 + specification.observers)
            .max_nodes(64)
            .create()
            .unwrap();
        let observations =
            service.publisher_builder().initial_max_slice_len(specification.batch.blocks()).create().unwrap();
        let text = serde_json::to_vec(&specification).unwrap();
        let published = publish(namespace, &specification.service, LAYOUT_VERSION, &text);
        Engine { observations, specification, _parts: Box::new((published, service, node)) }
    }

    /// Sends a batch of zeros from group 0.
    pub fn send(&mut self, step: u64) -> SentHeader {
        let zero = vec![PayloadBlock::zeroed(); self.specification.batch.blocks()];
        let mut message = self.observations.loan_slice_uninit(zero.len()).unwrap().write_from_slice(&zero);
        let header = message.user_header_mut();
        let incarnation = self.specification.incarnation;
        let (layout_version, default) = (LAYOUT_VERSION, ResponseHeader::default());
        *header = ResponseHeader { layout_version, incarnation, step, trainer: 42, request: 1, ..default };
        let (words, header) = (SharedWords::of(header), std::ptr::from_mut(header));
        let length = number_of_elements(message.header(), zero.len());
        let header = SentHeader { words, payload: SharedWords::of(message.payload_mut()), header, length };
        assert_eq!(message.send().unwrap(), 1);
        header
    }
}

/// An engine with the specification of one of `num_envs` environments, and its observer.
pub fn observed(num_envs: usize) -> (Place, Engine, Observer) {
    let place = Place::new();
    let model = place.engine("model", num_envs, 1);
    let specification = place.trainer("model").unwrap().specification().clone();
    model.end();
    let engine = Engine::new(place.namespace(), "foreign", &specification);
    let observer = Observer::connect(&place.connect_config("foreign"), 0).unwrap();
    (place, engine, observer)
}

/// A specification, published like an engine's until this is dropped.
struct Published {
    path: PathBuf,
    /// Holds the lock.
    _file: File,
}

impl Drop for Published {
    fn drop(&mut self) {
        std::fs::remove_file(&self.path).unwrap();
    }
}

/// Writes a status file: a sequence number, the engine's record and that of one group, their bells, and the specification.
fn publish(namespace: &Namespace, service: &str, layout_version: u32, text: &[u8]) -> Published {
    const RECORDS: usize = (32 + 24 + 2 * 8) * 8;
    let mut bytes = vec![0; RECORDS];
    let mut package = [0; 32];
    package[..5].copy_from_slice(b"0.0.9");
    let length = text.len() as u64;
    let head = [&b"EGYMSTAT"[..], &layout_version.to_ne_bytes(), &7_u32.to_ne_bytes(), &package, &length.to_ne_bytes()];
    let head = head.concat();
    bytes[8..][..head.len()].copy_from_slice(&head);
    // The number of groups, after incarnation and start time.
    bytes[8 + head.len() + 16..][..4].copy_from_slice(&1_u32.to_ne_bytes());
    bytes.extend_from_slice(text);
    let prefix = std::fs::read_to_string(namespace.root().join("prefix")).unwrap();
    let path = PathBuf::from(format!("/dev/shm/{prefix}{service}.{:016x}.status", 7));
    std::fs::write(&path, bytes).unwrap();
    let file = File::open(&path).unwrap();
    file.lock().unwrap();
    Published { path, _file: file }
}

/// An engine with another layout version.
pub fn engine_of_version(namespace: &Namespace, service: &str, layout_version: u32) -> impl Sized + use<> {
    let node = node(namespace);
    (publish(namespace, service, layout_version, b"not JSON"), node)
}

/// Publishes any text as a specification.
pub fn specification_text(namespace: &Namespace, service: &str, text: &[u8]) -> impl Sized + use<> {
    let node = node(namespace);
    (publish(namespace, service, LAYOUT_VERSION, text), node)
}

/// Publishes a specification under the name `service`, without the services that it describes.
pub fn specification(namespace: &Namespace, service: &str, specification: &ServiceSpecification) -> impl Sized + use<> {
    specification_text(namespace, service, &serde_json::to_vec(specification).unwrap())
}

/// An engine with the right version whose requests have another type.
pub fn engine_of_other_type(namespace: &Namespace, service: &str, model: &ServiceSpecification) -> impl Sized + use<> {
    let renamed = ServiceSpecification { service: service.to_owned(), ..model.clone() };
    let published = specification(namespace, service, &renamed);
    let node = node(namespace);
    let act = node.service_builder(&service_name(&renamed, "act")).publish_subscribe::<[u8]>().create().unwrap();
    (published, act, node)
}
