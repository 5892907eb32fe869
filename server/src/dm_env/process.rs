//! The stream of one connection: it owns the world that it has joined and answers in order.
//!
//! Invariants: the world is out of its slot for as long as the connection is in it, so that no step takes a lock; a failed
//! request is answered and the stream goes on; nothing is read ahead of the answers, so that a peer that reads none is
//! held up and costs nothing. A world ends with the connection that made it unless its maker gave it a lease; whoever is
//! in it then keeps it, and the lease ends it after that.

use super::{
    changes::{Changes, NewWorld},
    error::WorldError,
    properties,
    seat::{Interrupt, InterruptSender, Seat},
    settings::Settings,
    world::World,
};
use crate::{
    grpc::{
        CallError,
        aside::Aside,
        host::{Host, holder},
        interact::INLINE_ENVS,
    },
    sessions::{Guard, SessionError, SessionId},
    sim::options::shortened,
};
use bytes::{Bytes, BytesMut};
use futures_util::{Stream, stream};
use mazeway_proto::dm_env::{
    self as pb, environment_request::Payload as Request, environment_response::Payload as Response,
};
use mazeway_serving::Caller;
use prost::Message as _;
use std::{
    collections::BTreeMap,
    pin::Pin,
    sync::Arc,
    time::{Duration, Instant},
};
use tokio::{
    sync::{mpsc, oneshot},
    time::{Sleep, sleep_until, timeout_at},
};
use tokio_util::sync::WaitForCancellationFutureOwned;
use tonic::{Status, Streaming};

/// Answers the requests of `inbound`, in order.
pub fn process(
    host: Arc<Host>,
    caller: Caller,
    inbound: Streaming<Bytes>,
) -> impl Stream<Item = Result<Bytes, Status>> + Send {
    let process = Process::new(host, caller);
    // After the end there is no state, and so nothing more to be asked.
    stream::unfold(Some((process, inbound)), async |state| {
        let (mut process, mut inbound) = state?;
        match process.next(&mut inbound).await {
            Ok(Some(request)) => {
                let frame = process.answer(request).await;
                Some((Ok(frame), Some((process, inbound))))
            }
            Ok(None) => None,
            Err(status) => {
                // The world is back in its slot before the caller hears of the end.
                drop(process);
                Some((Err(status), None))
            }
        }
    })
}

/// One connection.
pub struct Process {
    host: Arc<Host>,
    caller: Caller,
    seat: Option<Seat>,
    /// Why there is no seat any more, where it was not left.
    lost: Option<SessionError>,
    /// Worlds that it has made and that end with it.
    made: Vec<SessionId>,
    last_used: Instant,
    /// Armed for the lease after some use; looked at anew when it fires, so that a step need not touch a timer.
    idle: Pin<Box<Sleep>>,
    shutdown: Pin<Box<WaitForCancellationFutureOwned>>,
    interrupt_sender: InterruptSender,
    interrupts: mpsc::Receiver<Interrupt>,
    /// Rings where somebody wants to see the world.
    wished: Aside,
    /// Memory of the answers, used again once they are sent.
    frame: BytesMut,
}

impl Process {
    /// A connection that has joined no world.
    pub fn new(host: Arc<Host>, caller: Caller) -> Self {
        let (interrupt_sender, interrupts) = mpsc::channel(1);
        Self {
            seat: None,
            lost: None,
            made: Vec::new(),
            last_used: Instant::now(),
            idle: Box::pin(sleep_until((Instant::now() + host.config.default_lease).into())),
            shutdown: Box::pin(host.shutdown.clone().cancelled_owned()),
            host,
            caller,
            interrupt_sender,
            interrupts,
            wished: Aside::new(),
            frame: BytesMut::new(),
        }
    }

    /// The next request; what else happens in the meantime is seen to.
    async fn next(&mut self, inbound: &mut Streaming<Bytes>) -> Result<Option<Bytes>, Status> {
        loop {
            // Requests come first: the rest is looked at only when none is waiting.
            tokio::select! {
                biased;
                message = inbound.message() => return message,
                Some(interrupt) = self.interrupts.recv() => {
                    // Without a seat its sender looks for the world again.
                    if let Some(seat) = &mut self.seat {
                        seat.interrupt(interrupt, &self.host);
                    }
                }
                () = self.wished.rung() => if let Some(seat) = &self.seat {
                    seat.show();
                },
                () = &mut self.shutdown => return Err(CallError::ShuttingDown.into()),
                () = &mut self.idle, if self.seat.is_some() => self.expire_if_idle(),
            }
        }
    }

    fn expire_if_idle(&mut self) {
        let lease = self.seat.as_ref().map_or(Duration::ZERO, Seat::lease);
        let expires = self.last_used + lease;
        if expires > Instant::now() {
            self.idle.as_mut().reset(expires.into());
        } else if let Some(seat) = self.seat.take() {
            self.lost = Some(SessionError::Expired);
            seat.expire();
        }
    }

    /// The frame of the answer to the frame of a request.
    pub async fn answer(&mut self, request: Bytes) -> Bytes {
        self.frame.clear();
        let outcome = match pb::EnvironmentRequest::decode(request) {
            Ok(request) => self.respond(request).await,
            Err(error) => Err(WorldError::Undecodable(error.to_string())),
        };
        let message = match outcome {
            // The answer to a step has been written already.
            Ok(None) => None,
            Ok(Some(response)) => Some(response),
            Err(error) => Some(Response::Error(error.into())),
        };
        if let Some(payload) = message {
            self.frame.clear();
            let response = pb::EnvironmentResponse { payload: Some(payload) };
            response.encode(&mut self.frame).expect("a buffer that grows");
        }
        self.last_used = Instant::now();
        self.frame.split().freeze()
    }

    async fn respond(&mut self, request: pb::EnvironmentRequest) -> Result<Option<Response>, WorldError> {
        let payload = request
            .payload
            .ok_or_else(|| WorldError::malformed("payload", "expected a request, got none that this protocol has"))?;
        Ok(Some(match payload {
            Request::Step(request) => {
                self.seated(false, move |seat, host, frame| seat.step(&request, host, frame)).await??;
                return Ok(None);
            }
            Request::Reset(request) => {
                let changes = Changes::from_settings(Settings::new(request.settings))?;
                let specs = self.seated(changes.are_costly(), move |seat, host, _| {
                    seat.reset(changes, true, host).map(|()| seat.specs().to_proto())
                });
                Response::Reset(pb::ResetResponse { specs: Some(specs.await??) })
            }
            Request::CreateWorld(request) => {
                let id = self.create(request.settings).await?;
                Response::CreateWorld(pb::CreateWorldResponse { world_name: id.to_string() })
            }
            Request::JoinWorld(request) => {
                let specs = Some(self.join(request).await?);
                Response::JoinWorld(pb::JoinWorldResponse { specs })
            }
            Request::LeaveWorld(pb::LeaveWorldRequest {}) => {
                (self.seat, self.lost) = (None, None);
                Response::LeaveWorld(pb::LeaveWorldResponse {})
            }
            Request::ResetWorld(request) => {
                self.reset_world(request).await?;
                Response::ResetWorld(pb::ResetWorldResponse {})
            }
            Request::DestroyWorld(request) => {
                self.destroy(&request.world_name)?;
                Response::DestroyWorld(pb::DestroyWorldResponse {})
            }
            Request::Extension(any) => {
                let request = properties::decode(&any)?;
                Response::Extension(if self.seat.is_some() {
                    let costly = properties::is_costly(&request);
                    self.seated(costly, move |seat, host, _| properties::answer(request, host, Some(seat))).await??
                } else {
                    properties::answer(request, &self.host, None)?
                })
            }
        }))
    }

    /// Does something in the joined world, where it costs others least.
    async fn seated<T: Send + 'static>(
        &mut self,
        costly: bool,
        work: impl FnOnce(&mut Seat, &Host, &mut BytesMut) -> T + Send + 'static,
    ) -> Result<T, WorldError> {
        let Some(mut seat) = self.seat.take() else {
            return Err(self.lost.clone().map_or(WorldError::NotJoined, WorldError::from));
        };
        if !costly && seat.num_envs() <= INLINE_ENVS {
            let outcome = work(&mut seat, &self.host, &mut self.frame);
            seat.show();
            self.seat = Some(seat);
            return Ok(outcome);
        }
        let (host, mut frame) = (Arc::clone(&self.host), std::mem::take(&mut self.frame));
        let done = off_thread(move || {
            let outcome = work(&mut seat, &host, &mut frame);
            seat.show();
            Ok((seat, frame, outcome))
        });
        // Should that panic, the world is gone.
        self.lost = Some(SessionError::Unknown);
        let (seat, frame, outcome) = done.await?;
        (self.seat, self.frame, self.lost) = (Some(seat), frame, None);
        Ok(outcome)
    }

    async fn create(&mut self, settings: BTreeMap<String, pb::Tensor>) -> Result<SessionId, WorldError> {
        let new = NewWorld::from_settings(Settings::new(settings))?;
        let (num_envs, lease, host) = (new.num_envs(), new.lease, Arc::clone(&self.host));
        let holder = holder(&self.caller);
        let id = off_thread(move || {
            let make = new.plan(&host.registry, &host.config)?;
            Ok(host.sessions.create(&holder, num_envs, lease, Instant::now(), make)?.0)
        });
        let id = id.await?;
        if lease.is_none() {
            // Others may have ended some: of those nothing is kept.
            if self.made.len() == self.made.capacity() {
                self.made.retain(|&id| self.host.sessions.contains(id));
            }
            self.made.push(id);
        }
        tracing::debug!(world = ?id, num_envs, "world created");
        Ok(id)
    }

    async fn join(&mut self, request: pb::JoinWorldRequest) -> Result<pb::ActionObservationSpecs, WorldError> {
        if self.seat.is_some() {
            return Err(WorldError::AlreadyJoined);
        }
        let id = world_name(&request.world_name)?;
        let changes = Changes::from_settings(Settings::new(request.settings))?;
        let owner = Arc::new(self.interrupt_sender.clone());
        let guard = self.host.sessions.take(id, self.caller.name(), Instant::now(), Some(owner))?;
        guard.set_waker(self.wished.waker().clone());
        let host = Arc::clone(&self.host);
        let seat = off_thread(move || Seat::take(guard, changes, &host)).await?;
        let specs = seat.specs().to_proto();
        self.idle.as_mut().reset((Instant::now() + seat.lease()).into());
        (self.seat, self.lost) = (Some(seat), None);
        Ok(specs)
    }

    fn destroy(&mut self, name: &str) -> Result<(), WorldError> {
        let id = world_name(name)?;
        if self.seat.as_ref().is_some_and(|seat| seat.id() == id) {
            return Err(WorldError::DestroyJoined);
        }
        self.take_world(id)?.close();
        self.made.retain(|&made| made != id);
        Ok(())
    }

    /// Takes a world for the while of a request.
    fn take_world(&self, id: SessionId) -> Result<Guard, WorldError> {
        let mut guard = self.host.sessions.take(id, self.caller.name(), Instant::now(), None)?;
        World::of(&mut *guard).ok_or(SessionError::Unknown)?;
        Ok(guard)
    }

    async fn reset_world(&mut self, request: pb::ResetWorldRequest) -> Result<(), WorldError> {
        let id = world_name(&request.world_name)?;
        let changes = Changes::from_settings(Settings::new(request.settings))?;
        if self.seat.as_ref().is_some_and(|seat| seat.id() == id) {
            return self.seated(changes.are_costly(), move |seat, host, _| seat.reset(changes, false, host)).await?;
        }
        let patience = self.host.config.default_lease;
        let silent = WorldError::AgentSilent { secs: patience.as_secs_f64() };
        let deadline = Instant::now() + patience;
        while Instant::now() < deadline {
            let owner = match self.take_world(id) {
                Ok(mut guard) => {
                    let host = Arc::clone(&self.host);
                    return off_thread(move || {
                        let world = World::of(&mut *guard).ok_or(SessionError::Unknown)?;
                        changes.apply(world, &host.registry, &host.config, true)?;
                        world.rebuild();
                        Ok(())
                    })
                    .await;
                }
                Err(WorldError::Occupied) => {
                    let owner = self.host.sessions.owner(id).and_then(|owner| owner.downcast::<InterruptSender>().ok());
                    owner.ok_or(WorldError::Occupied)?
                }
                Err(error) => return Err(error),
            };
            let (reply, answer) = oneshot::channel();
            let interrupt = Interrupt { world: id, changes: changes.clone(), reply };
            let told = async {
                owner.send(interrupt).await.ok()?;
                answer.await.ok()
            };
            tokio::select! {
                told = timeout_at(deadline.into(), told) => match told {
                    Ok(Some(outcome)) => return outcome,
                    // The agent has left: the world is free, or somebody else's.
                    Ok(None) => tokio::task::yield_now().await,
                    Err(_) => return Err(silent),
                },
                () = &mut self.shutdown => return Err(CallError::ShuttingDown.into()),
            }
        }
        Err(silent)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Back into its slot first: it may be one of those that end here.
        self.seat = None;
        for id in self.made.drain(..) {
            // A world that somebody else is in stays, and its lease ends it after that.
            if let Ok(guard) = self.host.sessions.take(id, self.caller.name(), Instant::now(), None) {
                guard.close();
            }
        }
    }
}

/// A name that no world can have is an unknown one; an empty one was forgotten.
fn world_name(name: &str) -> Result<SessionId, WorldError> {
    if name.is_empty() {
        return Err(WorldError::malformed("world_name", "expected the name of a world, got none"));
    }
    SessionId::parse(name).ok_or_else(|| {
        tracing::debug!(name = shortened(name), "no name of a world");
        SessionError::Unknown.into()
    })
}

/// Runs work that takes a while off the async threads.
async fn off_thread<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, WorldError> + Send + 'static,
) -> Result<T, WorldError> {
    let done = tokio::task::spawn_blocking(work).await;
    done.map_err(|error| WorldError::Call(CallError::Internal(error.to_string())))?
}
