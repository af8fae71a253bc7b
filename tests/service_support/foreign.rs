//! Engines and trainers that are not ours: written against the protocol, not with the library.

use std::time::{Duration, Instant};

use bytemuck::{Pod, Zeroable};
use endless_gym::batch::{Block, LAYOUT_VERSION};
use endless_gym::service::{Namespace, Specification};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;

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
#[type_name("endless_gym::ActionHeader")]
#[repr(C)]
pub struct ActionHeader {
    pub layout_version: u32,
    pub kind: u32,
    pub epoch: u64,
    pub trainer: u64,
    pub request: u64,
    pub seed: u64,
    pub env: u64,
    pub bytes: u64,
}

impl ActionHeader {
    pub fn reset_all(specification: &Specification) -> Self {
        let (layout_version, epoch) = (LAYOUT_VERSION, specification.epoch);
        ActionHeader { layout_version, kind: 2, epoch, trainer: 42, request: 1, seed: 0, env: 0, bytes: 0 }
    }
}

#[derive(Clone, Copy, Debug, ZeroCopySend)]
#[type_name("endless_gym::ObservationHeader")]
#[repr(C)]
pub struct ObservationHeader {
    layout_version: u32,
    group: u32,
    epoch: u64,
    step: u64,
    trainer: u64,
    request: u64,
    status: u32,
    text_length: u32,
    text: [u8; 192],
    snapshot: u64,
}

#[derive(Clone, Copy, Debug, ZeroCopySend)]
#[type_name("endless_gym::SpecificationHead")]
#[repr(C)]
struct Head {
    layout_version: u32,
    length: u32,
    package: [u8; 32],
}

#[derive(Clone, Copy, Debug, ZeroCopySend)]
#[type_name("endless_gym::SpecificationPiece")]
#[repr(C)]
struct Piece([u8; 4096]);

fn node(namespace: &Namespace) -> Node<ipc::Service> {
    std::fs::create_dir_all(namespace.root()).unwrap();
    std::fs::set_permissions(namespace.root(), std::os::unix::fs::PermissionsExt::from_mode(0o700)).unwrap();
    let mut config = Config::default();
    config.global.set_root_path(&Path::new(namespace.root().to_str().unwrap().as_bytes()).unwrap());
    config.global.prefix = FileName::new(namespace.prefix().as_bytes()).unwrap();
    NodeBuilder::new().config(&config).create().unwrap()
}

/// A trainer that sends what it likes.
pub struct Foreign {
    publisher: Publisher<ipc::Service, [PayloadBlock], ActionHeader>,
    subscriber: Subscriber<ipc::Service, [PayloadBlock], ObservationHeader>,
    blocks: usize,
    _node: Node<ipc::Service>,
}

impl Foreign {
    pub fn new(namespace: &Namespace, specification: &Specification) -> Self {
        let node = node(namespace);
        let name = |what: &str| {
            let name = format!("endless-gym/{}/{:016x}/{what}/0", specification.service, specification.epoch);
            ServiceName::new(&name).unwrap()
        };
        let blocks = specification.action.blocks();
        let act =
            node.service_builder(&name("act")).publish_subscribe::<[PayloadBlock]>().user_header::<ActionHeader>();
        let publisher = act.open().unwrap().publisher_builder().initial_max_slice_len(blocks).create().unwrap();
        let obs = node.service_builder(&name("obs")).publish_subscribe::<[PayloadBlock]>().user_header();
        let subscriber = obs.open().unwrap().subscriber_builder().create().unwrap();
        Foreign { publisher, subscriber, blocks, _node: node }
    }

    pub fn blocks(&self) -> usize {
        self.blocks
    }

    /// Sends a message and returns status and text of the answer, `None` if there is none.
    pub fn ask(&self, header: ActionHeader, blocks: usize, fill: impl FnOnce(&mut [Block])) -> Option<(u32, String)> {
        let zero = vec![PayloadBlock::zeroed(); blocks];
        let mut message = self.publisher.loan_slice_uninit(blocks).unwrap().write_from_slice(&zero);
        *message.user_header_mut() = header;
        fill(bytemuck::cast_slice_mut(message.payload_mut()));
        assert_eq!(message.send().unwrap(), 1);
        let start = Instant::now();
        while start.elapsed() < Duration::from_secs(1) {
            if let Some(answer) = self.subscriber.receive().unwrap() {
                let header = answer.user_header();
                assert_eq!((header.trainer, header.request), (42, 1));
                let text = String::from_utf8_lossy(&header.text[..header.text_length as usize]).into_owned();
                return Some((header.status, text));
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        None
    }
}

/// Publishes a specification as an engine would; it is there for as long as the value.
fn publish(node: &Node<ipc::Service>, service: &str, layout_version: u32, text: &[u8]) -> Box<dyn std::any::Any> {
    let mut package = [0; 32];
    package[..5].copy_from_slice(b"0.0.9");
    let head = Head { layout_version, length: text.len() as u32, package };
    let name = ServiceName::new(&format!("endless-gym/{service}")).unwrap();
    let mut board = node.service_builder(&name).blackboard_creator::<u32>().add(0, head);
    for (key, bytes) in (1..).zip(text.chunks(4096)) {
        let mut piece = Piece([0; 4096]);
        piece.0[..bytes.len()].copy_from_slice(bytes);
        board = board.add(key, piece);
    }
    let board = board.create().unwrap();
    let writer = board.writer_builder().create().unwrap();
    Box::new((writer, board))
}

/// An engine of another layout version.
pub fn engine_of_version(namespace: &Namespace, service: &str, layout_version: u32) -> Box<dyn std::any::Any> {
    let node = node(namespace);
    let published = publish(&node, service, layout_version, b"whatever it is");
    Box::new((published, node))
}

/// An engine that claims to be ours, but whose actions are of another type.
pub fn engine_of_other_type(
    namespace: &Namespace,
    service: &str,
    specification: &Specification,
) -> Box<dyn std::any::Any> {
    let node = node(namespace);
    let specification = Specification { service: service.to_owned(), ..specification.clone() };
    let name = format!("endless-gym/{service}/{:016x}/act/0", specification.epoch);
    let act = node.service_builder(&ServiceName::new(&name).unwrap()).publish_subscribe::<[u8]>().create().unwrap();
    let text = serde_json::to_vec(&specification).unwrap();
    let published = publish(&node, service, LAYOUT_VERSION, &text);
    Box::new((published, act, node))
}
