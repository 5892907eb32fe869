//! The `learner` command. Everything it can do lies in `cli`; the library knows no environment server, this binary
//! links one to host it when none is running.

mod cli;

fn main() -> std::process::ExitCode {
    cli::main()
}
