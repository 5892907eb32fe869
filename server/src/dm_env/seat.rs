//! An agent's place in a world: the world taken out of its slot, and where its sequence stands.
//!
//! Invariant: a refused call changes nothing. Deliberately absent: the stream, which owns the seat.

use super::{
    changes::Changes,
    error::WorldError,
    specs::{Lengths, Specs},
    world::World,
};
use crate::{
    batch::Batch as _,
    grpc::host::Host,
    sessions::{Guard, SessionError, SessionId},
};
use bytes::BytesMut;
use mazeway_proto::dm_env::{EnvironmentStateType, StepRequest};
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, oneshot};

/// A reset that another connection asks for, told to the agent by its next step.
pub struct Interrupt {
    /// Of which world.
    pub world: SessionId,
    /// What is to change.
    pub changes: Changes,
    /// Where the answer goes once the agent knows.
    pub reply: oneshot::Sender<Result<(), WorldError>>,
}

/// How others reach the agent in a world.
pub type InterruptSender = mpsc::Sender<Interrupt>;

/// The world that a connection has joined.
pub struct Seat {
    guard: Guard,
    specs: Specs,
    /// False where the next step begins a sequence.
    running: bool,
    interrupt: Option<Interrupt>,
    /// Packed actions and lengths of a step, kept so that steps need no memory.
    actions: Vec<u8>,
    lengths: Vec<Lengths>,
}

impl Seat {
    /// Sits down in a world.
    ///
    /// # Errors
    /// The session holds no world; the changes are refused. The session is put back then.
    pub fn take(mut guard: Guard, changes: Changes, host: &Host) -> Result<Self, WorldError> {
        let world = World::of(&mut *guard).ok_or(SessionError::Unknown)?;
        changes.apply(world, &host.registry, &host.config, true)?;
        world.rebuild();
        let specs = Specs::of(world);
        let (actions, lengths) = (Vec::new(), Vec::new());
        Ok(Self { guard, specs, running: false, interrupt: None, actions, lengths })
    }

    /// Which world it is in.
    pub fn id(&self) -> SessionId {
        self.guard.id()
    }

    /// Lets viewers see the world as it is now.
    pub fn show(&self) {
        self.guard.show();
    }

    /// How long the world outlives its last use.
    pub fn lease(&self) -> Duration {
        self.guard.lease()
    }

    /// What the agent can do and see.
    pub fn specs(&self) -> &Specs {
        &self.specs
    }

    /// Number of environments.
    pub fn num_envs(&self) -> usize {
        self.specs.batch().unwrap_or(1)
    }

    /// The world.
    pub fn world(&mut self) -> &mut World {
        World::of(&mut *self.guard).expect("seen when it was taken")
    }

    /// Ends the world and remembers that its lease ran out.
    pub fn expire(self) {
        self.guard.expire();
    }

    /// Acts or begins a sequence, and writes the answer into `frame`.
    ///
    /// # Errors
    /// Unknown observations; of a running sequence, wrong actions.
    pub fn step(&mut self, request: &StepRequest, host: &Host, frame: &mut BytesMut) -> Result<(), WorldError> {
        let requested = self.specs.requested(&request.requested_observations)?;
        let interrupted = self.running && self.interrupted(host);
        let Self { guard, specs, running, actions, lengths, .. } = self;
        let num_envs = guard.options().num_envs;
        let world = World::of(&mut **guard).expect("seen when it was taken");
        let state = if interrupted {
            *running = false;
            EnvironmentStateType::Interrupted
        } else if *running {
            specs.actions(&request.actions, actions)?;
            let begun = Instant::now();
            let buffers = world.step(actions)?;
            host.numbers.stepped(num_envs, begun.elapsed());
            let ended = (buffers.terminated()[0] == 1, buffers.truncated()[0] == 1);
            match ended {
                // Of a batch each environment begins anew by itself, and the sequence never ends.
                _ if specs.batch().is_some() => EnvironmentStateType::Running,
                (true, _) => EnvironmentStateType::Terminated,
                (false, true) => EnvironmentStateType::Interrupted,
                (false, false) => EnvironmentStateType::Running,
            }
        } else {
            world.begin()?;
            EnvironmentStateType::Running
        };
        *running = state == EnvironmentStateType::Running;
        specs.write_step(world.buffers(), state, requested, lengths, frame);
        Ok(())
    }

    /// Ends the sequence, so that the next step begins another. `told` says that the agent is sent the new specs.
    ///
    /// # Errors
    /// The changes are refused.
    pub fn reset(&mut self, changes: Changes, told: bool, host: &Host) -> Result<(), WorldError> {
        let world = self.world();
        changes.apply(world, &host.registry, &host.config, told)?;
        world.rebuild();
        self.specs = Specs::of(world);
        self.running = false;
        Ok(())
    }

    /// Somebody else resets the world: at once between sequences, with the agent's next step within one.
    pub fn interrupt(&mut self, interrupt: Interrupt, host: &Host) {
        if interrupt.world != self.id() {
            // Meant for an earlier seat: without an answer its sender looks for the world again.
            return;
        }
        if self.running {
            self.interrupt = Some(interrupt);
        } else {
            let answer = self.reset(interrupt.changes, false, host);
            // Nobody may wait for it any more.
            let _ = interrupt.reply.send(answer);
        }
    }

    /// True where a reset by somebody else ends the sequence with this step.
    fn interrupted(&mut self, host: &Host) -> bool {
        let Some(Interrupt { changes, reply, .. }) = self.interrupt.take() else { return false };
        let world = self.world();
        // The batch is made anew by the next step: this one still shows the last observations.
        let answer = changes.apply(world, &host.registry, &host.config, false);
        let interrupted = answer.is_ok();
        let _ = reply.send(answer);
        interrupted
    }
}
