//! The catalogue: environments by id, configured by options, behind one face whatever their kind.
//!
//! Invariants: environments of equal options that are in use at a time are one and the same, so that a session pays for its
//! state alone; one that nobody uses is freed. A tabular model is computed once for each environment and set of options,
//! even where many ask at a time, and the cache of models is bounded. Deliberately absent: transports and sessions.

use crate::{
    batch::{Batch, BatchOptions, SimBatch},
    rollout::{EpisodeChunk, RolloutPlan, roll_out},
    sim::{Configured, EnvSpec, OptionError, Simulator, TabularModel, highway, maze, options::shortened},
};
use serde_json::{Map, Value};
use sha2::{Digest as _, Sha256};
use std::{
    collections::HashMap,
    fmt,
    sync::{Arc, Mutex, OnceLock, PoisonError, Weak},
};

/// Options by name.
pub type Options = Map<String, Value>;

/// Models kept at a time; the least recently used one goes first.
const CACHED_MODELS: usize = 16;

/// Environments in use at which those are looked for that nobody uses any more; afterwards at twice as many as are left.
const SWEEP_AT: usize = 64;

/// A configured environment.
pub trait Environment: Send + Sync {
    /// Its description under the options.
    fn spec(&self) -> &Arc<EnvSpec>;
    /// A batch that was never reset.
    fn batch(self: Arc<Self>, options: BatchOptions) -> Box<dyn Batch>;
    /// Runs a checked plan; see [`roll_out`].
    fn roll_out(
        &self,
        plan: &RolloutPlan,
        cancelled: &(dyn Fn() -> bool + Sync),
        emit: &mut dyn FnMut(EpisodeChunk) -> bool,
    );
    /// Computes the tabular model; may take seconds. [`Registry::model`] keeps it.
    fn compute_model(&self) -> TabularModel;
}

/// A simulator whose tabular model can be computed.
trait Tabular: Simulator {
    fn model(configured: &Configured<Self>) -> TabularModel;
}

impl Tabular for highway::Highway {
    fn model(configured: &Configured<Self>) -> TabularModel {
        configured.model()
    }
}

impl Tabular for maze::Maze {
    fn model(configured: &Configured<Self>) -> TabularModel {
        configured.model()
    }
}

impl<S: Tabular> Environment for Configured<S> {
    fn spec(&self) -> &Arc<EnvSpec> {
        &self.spec
    }

    fn batch(self: Arc<Self>, options: BatchOptions) -> Box<dyn Batch> {
        Box::new(SimBatch::new(self, options))
    }

    fn roll_out(
        &self,
        plan: &RolloutPlan,
        cancelled: &(dyn Fn() -> bool + Sync),
        emit: &mut dyn FnMut(EpisodeChunk) -> bool,
    ) {
        roll_out(self, plan, cancelled, emit);
    }

    fn compute_model(&self) -> TabularModel {
        S::model(self)
    }
}

type Configure = fn(&Options) -> Result<Arc<dyn Environment>, OptionError>;

struct Entry {
    env_id: &'static str,
    configure: Configure,
}

/// Why an environment cannot be had.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RegistryError {
    /// No such environment.
    #[error("no environment {env_id:?}; there are {}", known.join(", "))]
    UnknownEnvironment {
        /// What came.
        env_id: String,
        /// What there is.
        known: Vec<&'static str>,
    },
    /// A wrong option.
    #[error("option {0}")]
    Option(#[from] OptionError),
}

/// The catalogue, in alphabetical order of the ids.
pub struct Registry {
    entries: Vec<Entry>,
    in_use: InUse,
    models: ModelCache,
}

impl Default for Registry {
    fn default() -> Self {
        Self::new()
    }
}

impl fmt::Debug for Registry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.env_ids()).finish()
    }
}

impl Registry {
    /// All environments of this crate.
    pub fn new() -> Self {
        let mut entries = vec![
            Entry { env_id: highway::ENV_ID, configure: |options| Ok(Arc::new(highway::configure(options)?)) },
            Entry { env_id: maze::ENV_ID, configure: |options| Ok(Arc::new(maze::configure(options)?)) },
        ];
        entries.sort_by_key(|entry| entry.env_id);
        Self { entries, in_use: InUse::default(), models: ModelCache::default() }
    }

    /// Ids in alphabetical order.
    pub fn env_ids(&self) -> impl Iterator<Item = &'static str> {
        self.entries.iter().map(|entry| entry.env_id)
    }

    /// An environment under options; those not given take their defaults. As long as somebody keeps it, or a batch of it,
    /// whoever asks for equal options gets the same.
    ///
    /// # Errors
    /// No such environment, a wrong option.
    pub fn configure(&self, env_id: &str, options: &Options) -> Result<Arc<dyn Environment>, RegistryError> {
        let entry = self.entries.iter().find(|entry| entry.env_id == env_id);
        let entry = entry.ok_or_else(|| RegistryError::UnknownEnvironment {
            env_id: shortened(env_id),
            known: self.env_ids().collect(),
        })?;
        let key = given_key(entry.env_id, options);
        if let Some(environment) = self.in_use.get(&key) {
            return Ok(environment);
        }
        // Made without the lock, for it may take a while; of two who make the same, the first is kept.
        Ok(self.in_use.insert(key, (entry.configure)(options)?))
    }

    /// Every environment with default options, in alphabetical order.
    pub fn specs(&self) -> Vec<Arc<EnvSpec>> {
        let defaults = Options::new();
        let configured = self.entries.iter().map(|entry| (entry.configure)(&defaults));
        configured.map(|environment| Arc::clone(environment.expect("default options are valid").spec())).collect()
    }

    /// The tabular model of an environment, computed by the first who asks while the others wait.
    ///
    /// # Errors
    /// No such environment, a wrong option.
    pub fn model(&self, env_id: &str, options: &Options) -> Result<Arc<TabularModel>, RegistryError> {
        let environment = self.configure(env_id, options)?;
        let key = cache_key(environment.spec(), options);
        Ok(self.models.get_or_compute(key, || environment.compute_model()))
    }
}

/// Numbers as floating point, so that two spellings of one are equal.
fn canonical(value: &Value) -> Value {
    match value {
        Value::Number(number) => number.as_f64().map_or_else(|| value.clone(), Value::from),
        Value::Array(items) => items.iter().map(canonical).collect(),
        Value::Object(map) => map.iter().map(|(key, value)| (key.clone(), canonical(value))).collect(),
        Value::Null | Value::Bool(_) | Value::String(_) => value.clone(),
    }
}

fn canonical_options(given: &Options) -> impl Iterator<Item = (String, Value)> {
    given.iter().map(|(name, value)| (name.clone(), canonical(value)))
}

/// Digest of the id and the options that were given: equal for configurations asked for alike, and short however long they are.
fn given_key(env_id: &str, given: &Options) -> Key {
    Sha256::digest(format!("{env_id} {}", Value::Object(canonical_options(given).collect()))).into()
}

/// The id and every option, given or default: equal for equal configurations.
fn cache_key(spec: &EnvSpec, given: &Options) -> String {
    let mut options: Options = spec.options.iter().map(|o| (o.name.to_owned(), canonical(&o.default))).collect();
    options.extend(canonical_options(given));
    format!("{} {}", spec.env_id, Value::Object(options))
}

type Key = [u8; 32];

/// Environments that somebody keeps, by what was asked for; bounded by the number of those who keep them.
#[derive(Default)]
struct InUse(Mutex<Kept>);

#[derive(Default)]
struct Kept {
    environments: HashMap<Key, Weak<dyn Environment>>,
    sweep_at: usize,
}

impl InUse {
    fn get(&self, key: &Key) -> Option<Arc<dyn Environment>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).environments.get(key)?.upgrade()
    }

    /// Keeps `made`, unless another was quicker: then it gives back that one.
    fn insert(&self, key: Key, made: Arc<dyn Environment>) -> Arc<dyn Environment> {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(other) = kept.environments.get(&key).and_then(Weak::upgrade) {
            return other;
        }
        if kept.environments.len() >= kept.sweep_at {
            kept.environments.retain(|_, environment| environment.strong_count() > 0);
            kept.environments.shrink_to(SWEEP_AT);
            kept.sweep_at = SWEEP_AT.max(2 * kept.environments.len());
        }
        kept.environments.insert(key, Arc::downgrade(&made));
        made
    }
}

/// A key and its model, once it is computed.
type CachedModel = (String, Arc<OnceLock<Arc<TabularModel>>>);

/// Most recently used last.
#[derive(Default)]
struct ModelCache(Mutex<Vec<CachedModel>>);

impl ModelCache {
    fn get_or_compute(&self, key: String, compute: impl FnOnce() -> TabularModel) -> Arc<TabularModel> {
        let cell = {
            let mut entries = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            let entry = match entries.iter().position(|(known, _)| *known == key) {
                Some(position) => entries.remove(position),
                None => (key, Arc::default()),
            };
            let cell = Arc::clone(&entry.1);
            if entries.len() == CACHED_MODELS {
                entries.remove(0);
            }
            entries.push(entry);
            cell
        };
        Arc::clone(cell.get_or_init(|| Arc::new(compute())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;
    use std::sync::atomic::{AtomicUsize, Ordering};

    fn options(value: Value) -> Options {
        value.as_object().expect("an object").clone()
    }

    fn any_model() -> TabularModel {
        Registry::new().configure("Maze-v0", &Options::new()).expect("known").compute_model()
    }

    #[test]
    fn ids_are_sorted_and_defaults_configure() {
        let registry = Registry::new();
        let ids: Vec<_> = registry.env_ids().collect();
        assert!(ids.is_sorted());
        assert_eq!(registry.specs().iter().map(|spec| spec.env_id).collect::<Vec<_>>(), ids);
    }

    #[test]
    fn an_unknown_environment_names_the_known_ones() {
        let error = Registry::new().configure("Maze-v9", &Options::new()).err().expect("refused");
        assert!(error.to_string().contains("\"Maze-v9\"") && error.to_string().contains("Maze-v0"), "{error}");
    }

    #[test]
    fn explicit_defaults_and_other_spellings_of_a_number_share_a_model() {
        let registry = Registry::new();
        let first = registry.model("Maze-v0", &Options::new()).expect("known");
        let spelled = registry.model("Maze-v0", &options(json!({"slip": 0.3}))).expect("known");
        assert!(Arc::ptr_eq(&first, &spelled));
        let none = registry.model("Maze-v0", &options(json!({"slip": 0}))).expect("known");
        let none_again = registry.model("Maze-v0", &options(json!({"slip": 0.0}))).expect("known");
        assert!(Arc::ptr_eq(&none, &none_again) && !Arc::ptr_eq(&first, &none));
    }

    #[test]
    fn equal_options_share_an_environment_while_it_is_in_use() {
        let registry = Registry::new();
        let configure = |value| registry.configure("Maze-v0", &options(value)).expect("valid options");
        let (first, slippery) = (configure(json!({"slip": 1})), configure(json!({"slip": 0.5})));
        assert!(Arc::ptr_eq(&first, &configure(json!({"slip": 1.0}))) && !Arc::ptr_eq(&first, &slippery));
        // A batch keeps it.
        let watch = Arc::downgrade(&first);
        let options = BatchOptions {
            num_envs: 1,
            autoreset: crate::batch::Autoreset::NextStep,
            max_episode_steps: 0,
            action_masks: false,
        };
        let batch = first.batch(options);
        assert!(Arc::ptr_eq(&watch.upgrade().expect("kept"), &configure(json!({"slip": 1}))));
        drop(batch);
        assert_eq!(watch.strong_count(), 0);
    }

    #[test]
    fn environments_that_nobody_uses_are_forgotten() {
        let registry = Registry::new();
        let configure = |slip: usize| {
            registry.configure("Maze-v0", &options(json!({"slip": 1.0 / slip as f64}))).expect("valid options")
        };
        let used: Vec<_> = (1..=10).map(configure).collect();
        for slip in 11..100 * SWEEP_AT {
            configure(slip);
        }
        let kept = registry.in_use.0.lock().expect("not poisoned").environments.len();
        assert!((used.len()..=SWEEP_AT + used.len()).contains(&kept), "{kept}");
        assert!((1..=10).zip(&used).all(|(slip, environment)| Arc::ptr_eq(environment, &configure(slip))));
    }

    #[test]
    fn concurrent_callers_compute_once() {
        let (cache, model, computed) = (ModelCache::default(), any_model(), AtomicUsize::new(0));
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    cache.get_or_compute("same".into(), || {
                        computed.fetch_add(1, Ordering::Relaxed);
                        model.clone()
                    })
                });
            }
        });
        assert_eq!(computed.into_inner(), 1);
    }

    #[test]
    fn the_cache_is_bounded_and_keeps_what_is_used() {
        let (cache, model) = (ModelCache::default(), any_model());
        let kept = cache.get_or_compute("kept".into(), || model.clone());
        for i in 0..2 * CACHED_MODELS {
            cache.get_or_compute(i.to_string(), || model.clone());
            cache.get_or_compute("kept".into(), || unreachable!("it is in use"));
        }
        assert_eq!(cache.0.lock().expect("not poisoned").len(), CACHED_MODELS);
        assert!(Arc::ptr_eq(&kept, &cache.get_or_compute("kept".into(), || unreachable!())));
    }
}
