//! Drives the highway at random, records the drive under a style of its own, and learns what that driver wants.
//!
//! Needs both services: `server` and `learner serve`.

use mazeway_client::{Demonstration, Env, Learner};
use mazeway_proto::learner::{FitRequest, TrajectoryFilter};

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut env = Env::connect("127.0.0.1:50051", "Highway-v0", Default::default()).await?;
    let (n_states, n_actions) = (env.spec().n_states, env.spec().n_actions);
    let (mut observation, _) = env.reset(Some(7)).await?;
    let (mut states, mut actions) = (Vec::new(), Vec::new());
    for step in 0..200 {
        let action = step * 5 % n_actions;
        states.push(observation.discrete().unwrap_or_default());
        actions.push(action);
        observation = env.step(action).await?.observation;
    }
    env.close().await?;

    let model = mazeway_client::model("127.0.0.1:50051", "Highway-v0", &Default::default()).await?;
    let learner = Learner::connect("127.0.0.1:50052").await?;
    learner.put_model(&model).await?;
    let mut recorder = learner.recorder();
    let (env_id, style, model_id) = ("Highway-v0".to_owned(), "mine".to_owned(), model.model_id.clone());
    let drive = Demonstration { env_id, style, model_id, n_states, n_actions, states, actions, ..Default::default() };
    recorder.record(drive).await?;
    recorder.finish().await?; // on stable storage from here on

    let filter = TrajectoryFilter { env_id: "Highway-v0".into(), style: "mine".into(), ..Default::default() };
    let request = FitRequest { method: "em-tied".into(), filter: Some(filter), ..Default::default() };
    let fit = learner.fit(request, |progress| println!("{}: {:.3}", progress.iteration, progress.objective)).await?;
    println!("agreement {:.2} after {} iterations", fit.agreement, fit.iterations);
    Ok(())
}
