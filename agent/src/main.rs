//! The `merganser` program; see [`merganser::cli`].

fn main() -> std::process::ExitCode {
    merganser::cli::main(std::env::args_os())
}
