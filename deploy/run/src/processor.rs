//! The processor's name, with its generation, which the model's name often lacks.

/// Returns the model's name and, for AMD's and Intel's servers, its generation in brackets.
/// - `cpuinfo`: contents of `/proc/cpuinfo`.
pub(crate) fn name(cpuinfo: &str) -> Option<String> {
    let value = |name: &str| {
        let lines = cpuinfo.lines().filter_map(|line| line.split_once(':'));
        let mut values = lines.filter(|(key, _)| key.trim() == name);
        values.next().map(|(_, value)| value.trim().to_owned())
    };
    let number = |name: &str| value(name)?.parse::<u32>().ok();
    let model_name = value("model name")?;
    let generation = match (value("vendor_id").as_deref(), number("cpu family"), number("model")) {
        (Some("AuthenticAMD"), Some(family), Some(model)) => amd(family, model),
        (Some("GenuineIntel"), Some(6), Some(model)) => intel(model),
        _ => None,
    };
    Some(match generation {
        Some(generation) => format!("{model_name} ({generation})"),
        None => model_name,
    })
}

fn amd(family: u32, model: u32) -> Option<&'static str> {
    Some(match (family, model) {
        (0x17, 0x00..=0x2f) => "Zen",
        (0x17, _) => "Zen 2",
        (0x19, 0x10..=0x1f | 0x60..=0x7f | 0xa0..=0xaf) => "Zen 4",
        (0x19, _) => "Zen 3",
        (0x1a, _) => "Zen 5",
        _ => return None,
    })
}

fn intel(model: u32) -> Option<&'static str> {
    Some(match model {
        0x3f => "Haswell",
        0x4f | 0x56 => "Broadwell",
        // Skylake and its successors of the same model.
        0x55 => "Skylake",
        0x6a | 0x6c => "Ice Lake",
        0x8f => "Sapphire Rapids",
        0xcf => "Emerald Rapids",
        0xad | 0xae => "Granite Rapids",
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cpuinfo(vendor: &str, family: u32, model: u32, name: &str) -> String {
        format!(
            "processor\t: 0\nvendor_id\t: {vendor}\ncpu family\t: {family}\n\
             model\t\t: {model}\nmodel name\t: {name}\ncpu MHz\t: 2000.0\n"
        )
    }

    #[test]
    fn the_generation_follows_the_name_where_it_is_known() {
        let epyc = |family, model| name(&cpuinfo("AuthenticAMD", family, model, "AMD EPYC"));
        for (family, model, generation) in [
            (23, 1, "Zen"),
            (23, 49, "Zen 2"),
            (25, 1, "Zen 3"),
            (25, 17, "Zen 4"),
            (26, 2, "Zen 5"),
        ] {
            let expected = format!("AMD EPYC ({generation})");
            assert_eq!(epyc(family, model), Some(expected), "family {family}, model {model}");
        }
        assert_eq!(epyc(27, 0).as_deref(), Some("AMD EPYC"));
        let xeon = name(&cpuinfo("GenuineIntel", 6, 143, "Intel Xeon"));
        assert_eq!(xeon.as_deref(), Some("Intel Xeon (Sapphire Rapids)"));
        // As on aarch64.
        assert_eq!(name("processor\t: 0\nCPU part\t: 0xd40\n"), None);
    }
}
