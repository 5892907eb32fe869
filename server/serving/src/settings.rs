//! One configuration from four places: a flag wins over the environment, the environment over the file, the file over the
//! default.
//!
//! Whatever is a flag of a command is also a variable, which is a prefix and the flag's name in capitals, and a key of the
//! file, which is the flag's name. The file is checked by the flags' own parsers and then taken for their defaults, so that
//! no value can mean one thing here and another there. Invariant: what [`Settings::effective`] writes is such a file, and says again
//! what it said.

use clap::{Arg, ArgAction, ArgMatches, Command, FromArgMatches, builder::FalseyValueParser, parser::ValueSource};
use std::{
    collections::BTreeMap,
    ffi::OsString,
    fmt::Write as _,
    fs, io,
    io::Read as _,
    path::{Path, PathBuf},
};

/// Largest file, in bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;
/// Names from here on are alike enough to be meant.
const ALIKE: f64 = 0.8;

/// Why there is no configuration.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// The command line, or a variable.
    #[error(transparent)]
    Usage(#[from] Box<clap::Error>),
    /// The file.
    #[error("{path}: {message}", path = .path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// What is wrong with it.
        message: String,
    },
}

/// What was read, and from where.
#[derive(Debug)]
pub struct Settings {
    /// The whole command line.
    pub matches: ArgMatches,
    /// The command whose flags are the settings.
    command: Command,
    /// The file, where there is one.
    file: Option<PathBuf>,
    /// Keys that it has.
    from_file: Vec<String>,
    /// What begins the name of every variable.
    prefix: String,
}

/// Where the flags of a service are: at the command itself, or at a command below it.
type Place = Option<&'static str>;

/// Parses a command line whose command takes settings at `places`; `prefix` begins the name of every variable.
///
/// # Errors
/// A flag, a variable or the file is wrong.
pub fn parse(
    command: Command,
    prefix: &str,
    places: &[Place],
    args: impl IntoIterator<Item = OsString>,
) -> Result<Settings, SettingsError> {
    let args: Vec<_> = args.into_iter().collect();
    let mut command = with_variables(command, prefix, places);
    let usage = |error| SettingsError::Usage(Box::new(error));
    let matches = command.clone().try_get_matches_from(&args).map_err(usage)?;
    let below = matches.subcommand_name().and_then(|name| places.iter().flatten().find(|place| **place == name));
    let own = |command: &Command| below.map_or(command.clone(), |name| subcommand(command, name));
    let flags = below.map_or(Some(&matches), |name| matches.subcommand_matches(name));
    let asked = flags.and_then(|flags| flags.try_get_one::<PathBuf>("config").ok().flatten()).cloned();
    let Some(path) = asked else {
        return Ok(Settings {
            command: own(&command),
            matches,
            file: None,
            from_file: Vec::new(),
            prefix: prefix.into(),
        });
    };
    let read = read(&path).and_then(|text| values(&text, &own(&command)));
    let values = read.map_err(|message| SettingsError::File { path: path.clone(), message })?;
    let from_file = values.keys().cloned().collect();
    let with_defaults = |command: Command| {
        command.mut_args(|arg| match arg.get_long().and_then(|long| values.get(long)) {
            Some(value) => arg.default_value(value.clone()),
            None => arg,
        })
    };
    command = match below {
        Some(name) => command.mut_subcommand(name, with_defaults),
        None => with_defaults(command),
    };
    let matches = command.clone().try_get_matches_from(&args).map_err(usage)?;
    Ok(Settings { command: own(&command), matches, file: Some(path), from_file, prefix: prefix.into() })
}

/// The command with a variable for every flag.
fn with_variables(command: Command, prefix: &str, places: &[Place]) -> Command {
    let mut command = command;
    for place in places {
        let with = |command: Command| {
            command.mut_args(|arg| {
                let Some(long) = arg.get_long() else { return arg };
                let variable = arg.get_env().map_or_else(|| variable(prefix, long).into(), OsString::from);
                let switch = matches!(arg.get_action(), ArgAction::SetTrue);
                let arg = arg.env(variable).hide_env_values(true);
                if switch { arg.value_parser(FalseyValueParser::new()) } else { arg }
            })
        };
        command = match place {
            Some(name) => command.mut_subcommand(name, with),
            None => with(command),
        };
    }
    command
}

/// The names of variables that begin like those of settings and are none of `command`'s.
fn strangers(command: &Command, prefix: &str, names: impl Iterator<Item = OsString>) -> Vec<String> {
    let mut strangers: Vec<_> = names
        .filter_map(|name| name.into_string().ok())
        .filter(|name| name.starts_with(prefix))
        .filter(|name| !command.get_arguments().any(|arg| arg.get_env().is_some_and(|env| env == name.as_str())))
        .map(|name| {
            let long = name[prefix.len()..].to_lowercase().replace('_', "-");
            match alike(&long, command) {
                Some(meant) => format!("{name}; did you mean {}?", variable(prefix, meant)),
                None => name,
            }
        })
        .collect();
    strangers.sort();
    strangers
}

fn variable(prefix: &str, long: &str) -> String {
    format!("{prefix}{}", long.to_uppercase().replace('-', "_"))
}

fn subcommand(command: &Command, name: &str) -> Command {
    command.find_subcommand(name).cloned().unwrap_or_else(|| Command::new(name.to_owned()))
}

/// The flags that are settings.
fn settings(command: &Command) -> impl Iterator<Item = (&str, &Arg)> {
    command
        .get_arguments()
        .filter_map(|arg| Some((arg.get_long()?, arg)))
        .filter(|(long, _)| !matches!(*long, "config" | "help" | "version"))
}

fn read(path: &Path) -> Result<String, String> {
    let cannot = |error: io::Error| format!("cannot be read: {error}");
    let mut text = String::new();
    fs::File::open(path).map_err(cannot)?.take(MAX_FILE_BYTES + 1).read_to_string(&mut text).map_err(cannot)?;
    if text.len() as u64 > MAX_FILE_BYTES {
        return Err(format!("expected at most {MAX_FILE_BYTES} bytes"));
    }
    Ok(text)
}

/// The values of a file, by the flags that they are for, once the flags' own parsers have taken them.
///
/// # Errors
/// The text is no TOML, has a key that is no flag, or a value that its flag does not take.
pub fn values(text: &str, command: &Command) -> Result<BTreeMap<String, String>, String> {
    let table: toml::Table = toml::from_str(text).map_err(|error| crate::tokens::one_line(text, &error))?;
    let mut values = BTreeMap::new();
    for (key, value) in table {
        let long = key.replace('_', "-");
        let Some((_, arg)) = settings(command).find(|(name, _)| *name == long) else {
            return Err(unknown(&key, &long, command));
        };
        let value = match value {
            toml::Value::String(text) => text,
            toml::Value::Integer(number) => number.to_string(),
            toml::Value::Float(number) => number.to_string(),
            toml::Value::Boolean(on) => on.to_string(),
            other => {
                return Err(format!("{key}: expected a string, a number or true or false, got {}", other.type_str()));
            }
        };
        check(command, arg, &long, &value).map_err(|message| format!("{key}: {message}"))?;
        if values.insert(long, value).is_some() {
            return Err(format!("{key}: expected it once, got it with - and with _"));
        }
    }
    Ok(values)
}

/// The setting that a name is most like, if any is.
fn alike<'a>(long: &str, command: &'a Command) -> Option<&'a str> {
    settings(command)
        .map(|(name, _)| (strsim::jaro_winkler(long, name), name))
        .filter(|(likeness, _)| *likeness >= ALIKE)
        .max_by(|one, other| one.0.total_cmp(&other.0))
        .map(|(_, name)| name)
}

fn unknown(key: &str, long: &str, command: &Command) -> String {
    let shown: String = key.chars().filter(|c| !c.is_control()).take(80).collect();
    match alike(long, command) {
        Some(name) => format!("there is no setting {shown:?}; did you mean {name:?}?"),
        None => format!("there is no setting {shown:?}"),
    }
}

/// Has a flag's own parser look at a value.
fn check(command: &Command, arg: &Arg, long: &str, value: &str) -> Result<(), String> {
    if matches!(arg.get_action(), ArgAction::SetTrue) {
        return match value {
            "true" | "false" => Ok(()),
            _ => Err("expected true or false".into()),
        };
    }
    // Alone, so that it is its value that is refused and no variable interferes.
    let alone = Command::new(command.get_name().to_owned()).arg(arg.clone().env(clap::builder::Resettable::Reset));
    let tried = alone.try_get_matches_from([command.get_name().to_owned(), format!("--{long}={value}")]);
    tried.map(|_| ()).map_err(|error| {
        let text = error.to_string();
        let first = text.lines().next().unwrap_or_default();
        // "error: invalid value 'x' for '--name <N>': why"
        let why = first.split_once(">': ").map_or(first.trim_start_matches("error: "), |(_, why)| why);
        let shown: String = value.chars().take(80).collect();
        format!("{why}, got {shown:?}")
    })
}

impl Settings {
    /// The command line as a type.
    ///
    /// # Errors
    /// A value that the type does not take.
    pub fn typed<T: FromArgMatches>(&self) -> Result<T, SettingsError> {
        T::from_arg_matches(&self.matches).map_err(|error| SettingsError::Usage(Box::new(error)))
    }

    /// The flags of the service.
    pub fn flags(&self) -> &ArgMatches {
        match self.matches.subcommand() {
            Some((name, flags)) if name == self.command.get_name() => flags,
            _ => &self.matches,
        }
    }

    /// Variables that look like settings and are none, each with what it may have meant.
    fn strangers(&self) -> Vec<String> {
        strangers(&self.command, &self.prefix, std::env::vars_os().map(|(name, _)| name))
    }

    /// Logs a warning of every variable that looks like a setting and is none: not an error, since others may set variables
    /// that begin alike, as Kubernetes does for a service of such a name.
    pub fn warn_of_strangers(&self) {
        for stranger in self.strangers() {
            tracing::warn!("there is no setting {stranger}");
        }
    }

    /// The configuration as a file that says the same, with where each value comes from.
    pub fn effective(&self) -> String {
        let flags = self.flags();
        let mut text = String::new();
        for stranger in self.strangers() {
            let _ = writeln!(text, "# there is no setting {stranger}\n");
        }
        for (long, arg) in settings(&self.command) {
            if let Some(help) = arg.get_help() {
                let _ = writeln!(text, "# {}", help.to_string().split_whitespace().collect::<Vec<_>>().join(" "));
            }
            let id = arg.get_id().as_str();
            let variable = arg.get_env().map(|name| name.to_string_lossy()).unwrap_or_default();
            let Some(value) = flags.get_raw(id).and_then(|mut values| values.next()) else {
                let _ = writeln!(text, "# {long} =  # not set; {variable}\n");
                continue;
            };
            let value = match arg.get_action() {
                ArgAction::SetTrue => flags.get_flag(id).to_string(),
                _ => written(&value.to_string_lossy()),
            };
            let source = match flags.value_source(id) {
                Some(ValueSource::CommandLine) => format!("flag --{long}"),
                Some(ValueSource::EnvVariable) => format!("environment, {variable}"),
                _ if self.from_file.iter().any(|key| key == long) => {
                    format!("file {}", self.file.as_deref().unwrap_or(Path::new("")).display())
                }
                _ => format!("default; {variable}"),
            };
            let _ = writeln!(text, "{long} = {value}  # {source}\n");
        }
        text.truncate(text.trim_end().len());
        text.push('\n');
        text
    }
}

/// A value as TOML: a number where it would come back as it is, a string otherwise.
fn written(value: &str) -> String {
    let as_integer = value.parse::<i64>().is_ok_and(|number| number.to_string() == value);
    let as_float = value.contains('.') && value.parse::<f64>().is_ok_and(|n| n.is_finite() && n.to_string() == value);
    if as_integer || as_float { value.to_owned() } else { toml::Value::from(value).to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::{Args as _, Parser};

    #[derive(Debug, Parser)]
    struct Cli {
        #[arg(long)]
        config: Option<PathBuf>,
        #[command(flatten)]
        door: crate::DoorConfig,
    }

    fn run(file: Option<&str>, prefix: &str, args: &[&str]) -> Result<Settings, SettingsError> {
        let command = <Cli as clap::CommandFactory>::command().name("service");
        let mut all: Vec<OsString> = vec!["service".into()];
        let directory = tempfile::tempdir().expect("a directory");
        if let Some(text) = file {
            let path = directory.path().join("service.toml");
            fs::write(&path, text).expect("writes");
            all.extend(["--config".into(), path.into()]);
        }
        all.extend(args.iter().map(Into::into));
        parse(command, prefix, &[None], all)
    }

    fn value(settings: &Settings, id: &str) -> String {
        settings.flags().get_raw(id).and_then(|mut v| v.next()).expect(id).to_string_lossy().into_owned()
    }

    #[test]
    fn a_flag_wins_over_the_file_and_the_file_over_the_default() {
        let file = "max_connections = 7\nidle-timeout-secs = 2.5\nopen-reflection = true\ntokens = \"a b\"\n";
        let settings = run(Some(file), "MAZEWAY_NOBODY_", &["--max-connections", "9"]).expect("parses");
        assert_eq!(value(&settings, "max_connections"), "9");
        assert_eq!(value(&settings, "idle_timeout"), "2.5");
        assert_eq!(value(&settings, "stall_timeout"), "300");
        assert!(settings.flags().get_flag("open_reflection"));
        let text = settings.effective();
        for line in
            ["max-connections = 9  # flag", "idle-timeout-secs = 2.5  # file", "stall-timeout-secs = 300  # default"]
        {
            assert!(text.lines().any(|l| l.starts_with(line)), "{line}: {text}");
        }
        // What it says, it says again when it is read.
        let again = run(Some(&text), "MAZEWAY_NOBODY_", &[]).expect("parses");
        for (_, arg) in super::settings(&again.command) {
            let id = arg.get_id().as_str();
            let raw =
                |settings: &Settings| settings.flags().get_raw(id).map(|v| v.map(OsString::from).collect::<Vec<_>>());
            assert_eq!(raw(&again), raw(&settings), "{id}");
        }
    }

    #[test]
    fn a_wrong_file_is_refused_by_key() {
        for (file, expected) in [
            ("max-conections = 7", "there is no setting \"max-conections\"; did you mean \"max-connections\"?"),
            ("whatever = 7", "there is no setting \"whatever\""),
            ("config = \"x\"", "there is no setting \"config\""),
            ("max-connections = \"many\"", "max-connections: "),
            ("max-connections = -1", "max-connections: "),
            ("max-connections = [1]", "max-connections: expected a string, a number or true or false, got array"),
            ("max-connections = 1\nmax_connections = 2", "max_connections: expected it once"),
            (
                "idle-timeout-secs = 0",
                "idle-timeout-secs: expected a positive number of seconds, at most a year, got \"0\"",
            ),
            ("open-reflection = 1", "open-reflection: expected true or false"),
            ("[server]\n", "there is no setting \"server\""),
            ("max-connections = ", "line 1: "),
        ] {
            let error = run(Some(file), "MAZEWAY_NOBODY_", &[]).expect_err(file).to_string();
            assert!(error.contains(expected) && !error.contains('\n'), "{error:?} for {file:?}");
        }
        let missing = run(None, "MAZEWAY_NOBODY_", &["--config", "/nowhere/at/all"]).expect_err("refused");
        assert!(missing.to_string().contains("/nowhere/at/all: cannot be read"), "{missing}");
    }

    #[test]
    fn variables_that_are_no_settings_are_named() {
        let command = with_variables(<Cli as clap::CommandFactory>::command(), "MAZEWAY_X_", &[None]);
        let names = ["MAZEWAY_X_TOKEN", "MAZEWAY_X_TOKENS", "PATH", "MAZEWAY_X_PORT_1_TCP", "MAZEWAY_X_CONFIG"];
        let strangers = strangers(&command, "MAZEWAY_X_", names.into_iter().map(OsString::from));
        assert_eq!(strangers, ["MAZEWAY_X_PORT_1_TCP", "MAZEWAY_X_TOKEN; did you mean MAZEWAY_X_TOKENS?"]);
    }

    #[test]
    fn numbers_stay_what_they_are() {
        for (value, expected) in [
            ("12", "12"),
            ("2.5", "2.5"),
            ("012", "\"012\""),
            ("2.50", "\"2.50\""),
            ("nan", "\"nan\""),
            ("a\"b", "'a\"b'"),
            ("1e3", "\"1e3\""),
            ("/a", "\"/a\""),
            ("true", "\"true\""),
        ] {
            assert_eq!(written(value), expected);
        }
        let _ = crate::DoorConfig::augment_args(Command::new("door"));
    }
}
