//! Endpoints of rmw_zenoh: keys of topics, liveliness tokens of nodes and their endpoints, attachments of messages.
//!
//! Source: the design document and sources of `ros2/rmw_zenoh`, releases for Jazzy.

use twox_hash::XxHash3_128;

use super::names::RosName;
use super::qos::Qos;
use super::ros_type::RosType;
use super::type_hash::Distribution;

/// Root of liveliness tokens.
pub const TOKEN_ROOT: &str = "@ros2_lv";
/// Length of an attachment, bytes.
pub const ATTACHMENT_LEN: usize = 33;
/// Global identifier of an endpoint, 16 bytes.
pub type Gid = [u8; 16];

/// Kind of an endpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::Display)]
pub enum EndpointKind {
    /// Publisher of a topic.
    #[strum(serialize = "MP")]
    Publisher,
    /// Subscription to a topic.
    #[strum(serialize = "MS")]
    Subscription,
}

/// A node of ROS 2 on a session of zenoh.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Node {
    /// `ROS_DOMAIN_ID`.
    pub domain_id: u32,
    /// Id of the session: hexadecimal digits.
    pub zid: String,
    /// Namespace; `None`: the root.
    pub namespace: Option<RosName>,
    /// Name, without a slash.
    pub name: String,
    /// Distribution of the other nodes.
    pub distribution: Distribution,
}

/// Name of any node of a network, from its liveliness token or that of one of its endpoints.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct NodeName {
    /// Id of its session.
    pub zid: String,
    /// Namespace; the root is `/`.
    pub namespace: String,
    /// Name, without a slash.
    pub name: String,
}

impl NodeName {
    /// Reads a token; `None` if it is of another form.
    pub fn of_token(token: &str) -> Option<Self> {
        let mut chunks = token.split('/');
        let (root, _domain, zid) = (chunks.next()?, chunks.next()?, chunks.next()?);
        let [_node, _endpoint, _kind, _enclave] = [(); 4].map(|()| chunks.next());
        let (namespace, name) = (chunks.next()?, chunks.next()?);
        (root == TOKEN_ROOT).then(|| Self {
            zid: zid.to_owned(),
            namespace: namespace.replace('%', "/"),
            name: name.to_owned(),
        })
    }
}

impl std::fmt::Display for NodeName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.namespace.trim_end_matches('/'), self.name)
    }
}

impl Node {
    /// Liveliness token of the node.
    pub fn token(&self) -> String {
        let (domain, zid, identity) = (self.domain_id, &self.zid, self.identity());
        // Node 0, endpoint 0, and NN for a node.
        format!("{TOKEN_ROOT}/{domain}/{zid}/0/0/NN/{identity}")
    }

    /// The node as others see it.
    pub fn name_in_network(&self) -> NodeName {
        NodeName {
            zid: self.zid.clone(),
            namespace: self.namespace_or_root().to_owned(),
            name: self.name.clone(),
        }
    }

    /// Selector of the tokens of all nodes of this name in the domain, its own among them.
    pub fn namesakes(&self) -> String {
        let (domain, name) = (self.domain_id, mangled(&self.name));
        format!("{TOKEN_ROOT}/{domain}/*/*/*/NN/*/*/{name}")
    }

    /// Selector of the tokens of all publishers of a topic in the domain.
    pub fn publishers_of(&self, topic: &RosName) -> String {
        let (domain, topic) = (self.domain_id, mangled(topic.as_str()));
        format!("{TOKEN_ROOT}/{domain}/*/*/*/MP/*/*/*/{topic}/**")
    }

    /// Liveliness token of the endpoint `id` of its session (the node is number 0), which offers or requests `qos`.
    pub fn endpoint_token(
        &self,
        id: u32,
        kind: EndpointKind,
        topic: &RosName,
        ros_type: RosType,
        qos: Qos,
    ) -> String {
        let (domain, zid) = (self.domain_id, &self.zid);
        let (identity, topic) = (self.identity(), mangled(topic.as_str()));
        let name = ros_type.dds_name();
        let hash = ros_type.hash(self.distribution);
        format!("{TOKEN_ROOT}/{domain}/{zid}/0/{id}/{kind}/{identity}/{topic}/{name}/{hash}/{qos}")
    }

    /// Key on which messages of a topic are published.
    pub fn key(&self, topic: &RosName, ros_type: RosType) -> String {
        let keys = self.keys_of_any_hash(topic, ros_type);
        format!("{keys}/{}", ros_type.hash(self.distribution))
    }

    /// Key expression of a topic's messages, whatever the hash: publishers of every distribution match.
    pub fn any_hash(&self, topic: &RosName, ros_type: RosType) -> String {
        format!("{}/*", self.keys_of_any_hash(topic, ros_type))
    }

    fn keys_of_any_hash(&self, topic: &RosName, ros_type: RosType) -> String {
        // A topic begins with its slash.
        format!("{}{topic}/{}", self.domain_id, ros_type.dds_name())
    }

    /// Enclave, namespace and name in tokens.
    fn identity(&self) -> String {
        let namespace = mangled(self.namespace_or_root());
        format!("%/{namespace}/{}", mangled(&self.name))
    }

    fn namespace_or_root(&self) -> &str {
        self.namespace.as_ref().map_or("/", RosName::as_str)
    }
}

/// A name in a token: `/` becomes `%`.
fn mangled(name: &str) -> String {
    name.replace('/', "%")
}

/// Identifier of an endpoint: the hash of its token.
pub fn gid(token: &str) -> Gid {
    // Low half first, both little-endian: the whole in little-endian.
    XxHash3_128::oneshot(token.as_bytes()).to_le_bytes()
}

/// Attachment of a message: the sequence number of its publisher, the time of publication and its publisher.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attachment {
    /// Sequence number, from 1.
    pub sequence: i64,
    /// Time of publication, nanoseconds on the Unix clock.
    pub source_nanos: i64,
    /// The publisher.
    pub gid: Gid,
}

impl Attachment {
    /// The bytes on the wire.
    pub fn to_bytes(&self) -> [u8; ATTACHMENT_LEN] {
        let numbers = [self.sequence, self.source_nanos].map(i64::to_le_bytes);
        let mut bytes = numbers.into_iter().flatten().chain([16]).chain(self.gid);
        std::array::from_fn(|_| bytes.next().unwrap_or_default())
    }

    /// Reads the bytes of an attachment; `None` if they have another length or layout.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (sequence, rest) = bytes.split_first_chunk()?;
        let (source_nanos, rest) = rest.split_first_chunk()?;
        // The length of the identifier stands before it, in one byte.
        let (16, gid) = rest.split_first()? else {
            return None;
        };
        Some(Self {
            sequence: i64::from_le_bytes(*sequence),
            source_nanos: i64::from_le_bytes(*source_nanos),
            gid: gid.try_into().ok()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn name(text: &str) -> RosName {
        text.parse().unwrap()
    }

    fn node(namespace: Option<&str>) -> Node {
        Node {
            domain_id: 7,
            zid: "a1b2".into(),
            namespace: namespace.map(name),
            name: "v2vloc".into(),
            distribution: Distribution::Jazzy,
        }
    }

    fn points() -> RosName {
        name("/cav_1/points")
    }

    fn publisher_token(node: &Node) -> String {
        let (kind, ros_type) = (EndpointKind::Publisher, RosType::PointCloud2);
        node.endpoint_token(3, kind, &points(), ros_type, Qos::SENSOR_DATA)
    }

    const HASH: &str = "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5";

    #[test]
    fn keys_and_tokens_are_those_of_rmw_zenoh() {
        let (root, fleet) = (node(None), node(Some("/fleet/a")));
        assert_eq!(root.token(), "@ros2_lv/7/a1b2/0/0/NN/%/%/v2vloc");
        assert_eq!(fleet.token(), "@ros2_lv/7/a1b2/0/0/NN/%/%fleet%a/v2vloc");
        assert_eq!(
            publisher_token(&fleet),
            format!(
                "@ros2_lv/7/a1b2/0/3/MP/%/%fleet%a/v2vloc/%cav_1%points/sensor_msgs::msg::dds_::PointCloud2_/{HASH}/2::,5:,:,:,,"
            )
        );
        let key = "7/cav_1/points/sensor_msgs::msg::dds_::PointCloud2_";
        assert_eq!(
            root.key(&points(), RosType::PointCloud2),
            format!("{key}/{HASH}")
        );
        assert_eq!(
            root.any_hash(&points(), RosType::PointCloud2),
            format!("{key}/*")
        );
        let other = NodeName::of_token(&publisher_token(&fleet)).unwrap();
        assert_eq!(other, fleet.name_in_network());
        assert_eq!(other.to_string(), "/fleet/a/v2vloc");
        assert_eq!(
            NodeName::of_token(&root.token()),
            Some(root.name_in_network())
        );
        assert_eq!(NodeName::of_token("@ros2_lv/7/a1b2/0"), None);
        let humble = Node {
            distribution: Distribution::Humble,
            ..root
        };
        assert_eq!(
            humble.key(&points(), RosType::PointCloud2),
            format!("{key}/TypeHashNotSupported")
        );
    }

    #[test]
    fn a_gid_is_the_hash_of_the_token() {
        // XXH3-128 of no bytes, seed 0, in xxHash's own test vectors: 99aa06d3014798d8 6001c324468d497f.
        let empty = [
            0x7f, 0x49, 0x8d, 0x46, 0x24, 0xc3, 0x01, 0x60, 0xd8, 0x98, 0x47, 0x01, 0xd3, 0x06,
            0xaa, 0x99,
        ];
        assert_eq!(gid(""), empty);
        assert_ne!(gid(&publisher_token(&node(None))), gid(&node(None).token()));
    }

    #[test]
    fn an_attachment_is_laid_out_as_rmw_zenoh_lays_it_out() {
        let attachment = Attachment {
            sequence: 1,
            source_nanos: 0x0102_0304,
            gid: *b"0123456789abcdef",
        };
        let bytes = attachment.to_bytes();
        assert_eq!(
            bytes[..],
            b"\x01\0\0\0\0\0\0\0\x04\x03\x02\x01\0\0\0\0\x100123456789abcdef"[..]
        );
        assert_eq!(Attachment::from_bytes(&bytes), Some(attachment));
        let other_length = [bytes.as_slice(), &[0]].concat();
        let mut other_layout = bytes;
        other_layout[16] = 15;
        for bytes in [&bytes[..32], &other_length, &other_layout, &[]] {
            assert_eq!(Attachment::from_bytes(bytes), None);
        }
    }

    proptest! {
        #[test]
        fn any_attachment_is_read_back(sequence: i64, source_nanos: i64, gid: Gid) {
            let attachment = Attachment { sequence, source_nanos, gid };
            prop_assert_eq!(Attachment::from_bytes(&attachment.to_bytes()), Some(attachment));
        }
    }
}
