//! The properties extension: what environments there are with their options, and the settings of the joined world.
//!
//! Invariant: what is written holds from the next sequence on, and never changes the specs of an agent who is not told.

use super::{changes::Changes, error::WorldError, seat::Seat, settings::integer, tensor};
use crate::{
    batch::Batch as _,
    grpc::{CallError, host::Host},
    registry::{Options, RegistryError},
    sim::{
        EnvSpec,
        options::{kind, shortened},
    },
};
use mazeway_proto::dm_env::{
    DataType, Tensor, TensorSpec,
    extensions::properties::{
        ListPropertyResponse, PropertyRequest, PropertyResponse, PropertySpec, ReadPropertyResponse,
        WritePropertyResponse, property_request::Payload as Request, property_response::Payload as Response,
    },
};
use prost::Message as _;
use prost_types::Any;

const REQUEST: &str = "dm_env_rpc.v1.extensions.properties.PropertyRequest";
const RESPONSE_URL: &str = "type.googleapis.com/dm_env_rpc.v1.extensions.properties.PropertyResponse";
const SEED: &str = "world.seed";
const MAX_EPISODE_STEPS: &str = "world.max_episode_steps";
const WORLD_OPTIONS: &str = "world.options";

/// The request that an extension message holds.
///
/// # Errors
/// Another extension, no request.
pub fn decode(any: &Any) -> Result<Request, WorldError> {
    if any.type_url.rsplit('/').next() != Some(REQUEST) {
        return Err(WorldError::UnknownExtension { type_url: shortened(&any.type_url) });
    }
    let request = PropertyRequest::decode(&any.value[..])
        .map_err(|error| WorldError::malformed("extension.value", format!("expected a PropertyRequest: {error}")))?;
    request.payload.ok_or_else(|| WorldError::malformed("extension.value.payload", "expected a request, got none"))
}

/// True where the answer may take a while.
pub fn is_costly(request: &Request) -> bool {
    matches!(request, Request::WriteProperty(_))
}

/// Answers as a connection that has joined a world, or none.
///
/// # Errors
/// Unknown keys, values that cannot be read or written.
pub fn answer(request: Request, host: &Host, seat: Option<&mut Seat>) -> Result<Any, WorldError> {
    let payload = match request {
        Request::ListProperty(request) => {
            let values = list(&properties(host, seat), &request.key)?;
            Response::ListProperty(ListPropertyResponse { values })
        }
        Request::ReadProperty(request) => {
            let property = find(properties(host, seat), &request.key)?;
            let value = property.value.ok_or_else(|| match request.key.as_str() {
                SEED => WorldError::NoSeed,
                _ => denied(&request.key, "read"),
            })?;
            Response::ReadProperty(ReadPropertyResponse { value: Some(value) })
        }
        Request::WriteProperty(request) => {
            let value = request.value.unwrap_or_default();
            match seat {
                Some(seat) => write(&request.key, &value, host, seat)?,
                // Nothing outside a world can be written.
                None => find(properties(host, None), &request.key)
                    .and_then(|property| Err(denied(&property.key, "written")))?,
            }
            Response::WriteProperty(WritePropertyResponse {})
        }
    };
    let value = PropertyResponse { payload: Some(payload) }.encode_to_vec();
    Ok(Any { type_url: RESPONSE_URL.into(), value })
}

fn denied(key: &str, action: &'static str) -> WorldError {
    WorldError::PropertyDenied { key: key.to_owned(), action }
}

/// One node of the tree.
struct Property {
    key: String,
    /// Type and shape; none where it can only be listed.
    kind: Option<(DataType, Vec<i32>)>,
    value: Option<Tensor>,
    writable: bool,
    description: String,
}

impl Property {
    fn folder(key: impl Into<String>, description: impl Into<String>) -> Self {
        Self { key: key.into(), kind: None, value: None, writable: false, description: description.into() }
    }

    fn value(key: impl Into<String>, value: Tensor, description: impl Into<String>) -> Self {
        let kind = Some(tensor::kind(&value));
        Self { key: key.into(), kind, value: Some(value), writable: false, description: description.into() }
    }

    fn writable(self) -> Self {
        Self { writable: true, ..self }
    }

    fn parent(&self) -> &str {
        self.key.rsplit_once('.').map_or("", |(parent, _)| parent)
    }

    fn to_proto(&self) -> PropertySpec {
        let (dtype, shape) = self.kind.clone().unwrap_or_default();
        PropertySpec {
            spec: Some(TensorSpec { name: self.key.clone(), shape, dtype: dtype.into(), min: None, max: None }),
            is_readable: self.value.is_some(),
            is_writable: self.writable,
            is_listable: self.kind.is_none(),
            description: self.description.clone(),
        }
    }
}

fn list(properties: &[Property], key: &str) -> Result<Vec<PropertySpec>, WorldError> {
    match properties.iter().find(|property| property.key == key) {
        Some(property) if property.kind.is_some() => Err(WorldError::NotListable { key: key.to_owned() }),
        None if !key.is_empty() => Err(WorldError::UnknownProperty { key: shortened(key) }),
        _ => Ok(properties.iter().filter(|property| property.parent() == key).map(Property::to_proto).collect()),
    }
}

fn find(properties: Vec<Property>, key: &str) -> Result<Property, WorldError> {
    let found = properties.into_iter().find(|property| property.key == key);
    found.ok_or_else(|| WorldError::UnknownProperty { key: shortened(key) })
}

/// The whole tree, parents before their children.
fn properties(host: &Host, seat: Option<&mut Seat>) -> Vec<Property> {
    let mut all = vec![Property::folder("environments", "what worlds can be made of")];
    for spec in host.registry.specs() {
        let key = format!("environments.{}", spec.env_id);
        let number = |name: &str, value: u32, description: &str| {
            Property::value(format!("{key}.{name}"), tensor::uint64(u64::from(value)), description)
        };
        all.push(Property::folder(&key, spec.description));
        let steps = "steps after which a sequence is interrupted unless a setting says otherwise; 0 means never";
        all.push(number("max_episode_steps", spec.max_episode_steps, steps));
        all.push(number("n_states", spec.n_states, "number of states of the tabular model"));
        all.push(number("n_actions", spec.n_actions, "number of actions"));
        all.push(number("render_fps", spec.render_fps, "frames a second at which pictures look natural"));
        all.push(Property::folder(format!("{key}.options"), "options with their defaults, settings of a new world"));
        all.extend(options(&spec, &format!("{key}.options"), &Options::new()));
    }
    if let Some(seat) = seat {
        world(seat, &mut all);
    }
    all
}

fn world(seat: &mut Seat, all: &mut Vec<Property>) {
    let (name, lease) = (seat.id().to_string(), seat.lease());
    let world = seat.world();
    let (spec, options_now) = (world.next_spec(), world.next_options());
    all.push(Property::folder("world", "the joined world; what is written holds from the next sequence on"));
    all.push(Property::value("world.name", tensor::string(name), "its name"));
    all.push(Property::value("world.env_id", tensor::string(spec.env_id), "its environment"));
    let num_envs = tensor::uint64(world.options().num_envs as u64);
    all.push(Property::value("world.num_envs", num_envs, "number of environments"));
    let steps = tensor::uint64(u64::from(options_now.max_episode_steps));
    let description = "steps after which a sequence is interrupted; 0 means never";
    all.push(Property::value(MAX_EPISODE_STEPS, steps, description).writable());
    let secs = tensor::double(lease.as_secs_f64());
    all.push(Property::value("world.lease_secs", secs, "how long the world outlives its last use, in seconds"));
    let description = "seed given last: environment i of a batch takes seed + i; cannot be read before one was given";
    let seed = Property::value(SEED, tensor::uint64(world.seed().unwrap_or_default()), description).writable();
    all.push(Property { value: seed.value.filter(|_| world.seed().is_some()), ..seed });
    all.push(Property::folder(WORLD_OPTIONS, "options of the environment"));
    all.extend(options(spec, WORLD_OPTIONS, world.given()).map(Property::writable));
}

/// Options as given, or their defaults.
fn options<'a>(spec: &'a EnvSpec, key: &'a str, given: &'a Options) -> impl Iterator<Item = Property> + 'a {
    spec.options.iter().map(move |option| {
        let value = given.get(option.name).unwrap_or(&option.default);
        let value = tensor::from_json(value, &option.default);
        Property::value(format!("{key}.{}", option.name), value, option.description)
    })
}

fn write(key: &str, value: &Tensor, host: &Host, seat: &mut Seat) -> Result<(), WorldError> {
    if !find(properties(host, Some(seat)), key)?.writable {
        return Err(denied(key, "written"));
    }
    let value = tensor::to_json(value, "value")?;
    let within = |most: u64| {
        integer(&value, 0, most).ok_or_else(|| {
            let message = format!("expected an integer from 0 to {most}, got {}", kind(&value));
            WorldError::malformed("value", message)
        })
    };
    let changes = match key {
        SEED => Changes { seed: Some(within(u64::MAX)?), ..Changes::default() },
        MAX_EPISODE_STEPS => {
            let steps = within(u64::from(u32::MAX))? as u32;
            Changes { max_episode_steps: Some(steps), ..Changes::default() }
        }
        option => {
            let name = option.rsplit('.').next().unwrap_or_default();
            Changes { options: [(name.to_owned(), value)].into_iter().collect::<Options>(), ..Changes::default() }
        }
    };
    let outcome = changes.apply(seat.world(), &host.registry, &host.config, false);
    outcome.map_err(|error| match error {
        WorldError::Call(CallError::Registry(RegistryError::Option(error))) => {
            WorldError::malformed("value", error.message)
        }
        WorldError::SpecsWouldChange { message, .. } => WorldError::SpecsWouldChange { field: "value".into(), message },
        other => other,
    })
}
