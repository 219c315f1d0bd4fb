//! Changes of a `pipeline.toml` that keep its comments and its order.
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use dipir_scene::camera::Camera;
use dipir_scene::config::SceneConfig;
use glam::{DMat3, DVec3};
use toml_edit::{
    Array, ArrayOfTables, DocumentMut, InlineTable, Item, RawString, Table, TableLike, Value, value,
};

use crate::edit::{Edit, ObjectEdit, ShadowEdit, SunEdit, Turn};

/// A file's text, to be changed.
pub struct Document {
    toml: DocumentMut,
    /// Whether lines end as Windows writes them; the parser forgets it.
    crlf: bool,
}

/// `x` with at most `digits` behind the point.
fn rounded(x: f64, digits: i32) -> f64 {
    let scale = 10f64.powi(digits);
    let x = (x * scale).round() / scale;
    // No minus sign before a zero.
    if x == 0.0 { 0.0 } else { x }
}

fn numbers(values: impl IntoIterator<Item = f64>) -> Value {
    Value::Array(values.into_iter().collect::<Array>())
}

/// Sets a key; what stands around an earlier value, such as a comment, stays.
fn set(table: &mut dyn TableLike, key: &str, new: impl Into<Value>) {
    let mut new = new.into();
    match table.get_mut(key).and_then(Item::as_value_mut) {
        Some(old) => {
            *new.decor_mut() = old.decor().clone();
            *old = new;
        }
        None => {
            table.insert(key, value(new));
        }
    }
}

/// Brings the values of `array` into an `order` of indices that it has. Comments go with their values: what stands behind
/// a comma, up to the line's end, belongs to the value before it.
fn reorder(array: &mut Array, order: &[usize]) {
    let old = array.clone();
    let text = |raw: Option<&RawString>| {
        raw.and_then(RawString::as_str)
            .unwrap_or_default()
            .to_owned()
    };
    let before = old.iter().map(|v| text(v.decor().prefix()));
    let gaps: Vec<String> = before.chain([text(Some(old.trailing()))]).collect();
    // The line that gap `before` begins with, and the rest of gap `next`.
    let joined = |before: usize, next: usize| {
        let split = |gap: usize| gaps[gap].split_at(gaps[gap].find('\n').unwrap_or(0));
        let (behind, rest) = (split(before).0, split(next).1);
        // A comment ends with its line.
        let end = if behind.contains('#') && !rest.starts_with('\n') {
            "\n"
        } else {
            ""
        };
        format!("{behind}{end}{rest}")
    };
    array.clear();
    let mut last = 0;
    for &of in order {
        let Some(value) = old.get(of) else { continue };
        let mut value = value.clone();
        value.decor_mut().set_prefix(joined(last, of));
        array.push_formatted(value);
        last = of + 1;
    }
    array.set_trailing(joined(last, old.len()));
}

impl Document {
    /// Parses `text`.
    ///
    /// # Errors
    /// If it is no TOML.
    pub fn parse(text: &str) -> anyhow::Result<Self> {
        Ok(Self {
            toml: text.parse().context("pipeline.toml is no TOML")?,
            crlf: text.contains("\r\n"),
        })
    }

    /// The text.
    pub fn text(&self) -> String {
        let text = self.toml.to_string();
        match self.crlf {
            true => text.replace("\r\n", "\n").replace('\n', "\r\n"),
            false => text,
        }
    }

    /// The table `[name]`, made if it is not there.
    fn table(&mut self, name: &str) -> anyhow::Result<&mut dyn TableLike> {
        let item = self.toml.entry(name).or_insert(Item::Table(Table::new()));
        item.as_table_like_mut()
            .with_context(|| format!("[{name}] is no table"))
    }

    fn camera(&mut self) -> anyhow::Result<&mut dyn TableLike> {
        let scene = self.table("scene")?;
        let camera = scene.get_mut("camera").and_then(Item::as_table_like_mut);
        let camera = camera.context("[scene.camera] is missing")?;
        if camera.contains_key("transforms") {
            bail!("the camera comes from scene.camera.transforms and is not changed here");
        }
        Ok(camera)
    }

    /// Turns the camera; `camera` is the one that the text says. The field of view becomes `fov_deg`; with `None` it stays
    /// as it is told.
    ///
    /// # Errors
    /// If another file holds the camera, or a lens whose field of view is to change.
    pub fn turn(
        &mut self,
        turn: &Turn,
        fov_deg: Option<f64>,
        camera: &Camera,
    ) -> anyhow::Result<()> {
        let table = self.camera()?;
        // Beside a file that tells a lens alone the direction is written here.
        let is_here = fov_deg.is_none() && table.contains_key("position");
        if table.contains_key("file") && !is_here {
            bail!("the camera comes from scene.camera.file and is not changed here");
        }
        if let Some(fov_deg) = fov_deg {
            for key in ["focal_mm", "sensor_mm"] {
                table.remove(key);
            }
            set(table, "fov_deg", rounded(fov_deg, 3));
        }
        let (pitch, roll) = (turn.pitch_deg, turn.roll_deg);
        if !table.contains_key("look_at") {
            set(table, "pitch_deg", rounded(pitch, 3));
            set(table, "roll_deg", rounded(roll, 3));
            return Ok(());
        }
        let rotation = camera.rotation.as_dmat3();
        let heading = rotation.z_axis.x.atan2(rotation.z_axis.z);
        let rotation = DMat3::from_rotation_y(heading)
            * DMat3::from_rotation_x(pitch.to_radians())
            * DMat3::from_rotation_z(-roll.to_radians());
        // The direction loses nothing to rounding at ten metres.
        let at = camera.position.as_dvec3() - rotation.z_axis * 10.0;
        let written = |v: DVec3| numbers(v.to_array().map(|x| rounded(x, 5)));
        set(table, "look_at", written(at));
        if roll != 0.0 || table.contains_key("up") {
            set(table, "up", written(rotation.y_axis));
        }
        Ok(())
    }

    /// Moves the camera by `shift`, metres.
    ///
    /// # Errors
    /// If another file holds the camera.
    pub fn shift_camera(&mut self, camera: &Camera, shift: DVec3) -> anyhow::Result<()> {
        let table = self.camera()?;
        // Beside a file that tells a lens alone the position is written here.
        if table.contains_key("file") && !table.contains_key("position") {
            bail!("the camera comes from scene.camera.file and is not changed here");
        }
        let written = |v: DVec3| numbers(v.to_array().map(|x| rounded(x, 5)));
        let position = camera.position.as_dvec3();
        set(table, "position", written(position + shift));
        let old = table.get("look_at").and_then(Item::as_array);
        let number = |v: &Value| v.as_float().or(v.as_integer().map(|i| i as f64));
        let old: Vec<f64> = old.into_iter().flatten().filter_map(number).collect();
        if let [x, y, z] = old[..] {
            set(table, "look_at", written(DVec3::new(x, y, z) + shift));
        }
        Ok(())
    }

    /// Refuses a ground through a depth map: it turns and rises with the camera, which is not shown here.
    ///
    /// # Errors
    /// If the ground is one.
    pub fn refuse_ground_of_depths(&mut self) -> anyhow::Result<()> {
        let proxy = self.table("scene")?.get("proxy");
        let points = proxy.and_then(|p| p.as_table_like()?.get("points")?.as_str());
        let extension = points.and_then(|p| Path::new(p).extension());
        if extension.is_some_and(|e| ["exr", "png"].iter().any(|d| e.eq_ignore_ascii_case(d))) {
            bail!(
                "the ground is that of a depth map, which moves with the camera; change [scene.camera] in \
                 pipeline.toml and start dipir place anew"
            );
        }
        Ok(())
    }

    /// Says how high the camera stands over a ground that is told from the camera; `false` if the ground is told otherwise.
    ///
    /// # Errors
    /// If lengths on the ground say how high.
    pub fn height_over_ground(&mut self, height_m: f64) -> anyhow::Result<bool> {
        let scene = self.table("scene")?;
        let proxy = scene.get_mut("proxy").and_then(Item::as_table_like_mut);
        match proxy {
            Some(table) if table.contains_key("camera_height_m") => {
                set(table, "camera_height_m", rounded(height_m, 5));
                Ok(true)
            }
            Some(table) if table.contains_key("lengths_m") => {
                bail!("scene.proxy.lengths_m says how high the camera stands; change it there")
            }
            _ => Ok(false),
        }
    }

    /// Brings the objects into the order of `objects`, some of them copied or left out.
    ///
    /// # Errors
    /// If one is a copy of none, or none is left.
    pub fn order_objects(&mut self, objects: &[ObjectEdit]) -> anyhow::Result<()> {
        if objects.is_empty() {
            bail!("a scene needs an object");
        }
        let scene = self.table("scene")?;
        let list = scene
            .get_mut("objects")
            .context("scene.objects is missing")?;
        let order = objects.iter().map(|o| o.of);
        let missing = |of: usize| format!("there is no object {}", of.saturating_add(1));
        match list {
            Item::ArrayOfTables(tables) => {
                if order.clone().eq(0..tables.len()) {
                    return Ok(());
                }
                let mut new = ArrayOfTables::new();
                for of in order {
                    new.push(tables.get(of).with_context(|| missing(of))?.clone());
                }
                *tables = new;
            }
            Item::Value(Value::Array(array)) => {
                if order.clone().eq(0..array.len()) {
                    return Ok(());
                }
                let order: Vec<usize> = order.collect();
                if let Some(none) = order.iter().find(|of| **of >= array.len()) {
                    bail!(missing(*none));
                }
                reorder(array, &order);
            }
            _ => bail!("scene.objects is no list of tables"),
        }
        Ok(())
    }

    /// Refuses a `scene` of other objects than the text has: the text's own would be replaced by what is arranged.
    ///
    /// # Errors
    /// If their number or their files differ.
    pub fn refuse_other_objects(&mut self, scene: &SceneConfig) -> anyhow::Result<()> {
        let mut own = Vec::new();
        while let Ok(object) = self.object(own.len()) {
            let path = object.get("path").and_then(Item::as_str);
            own.push(path.map(PathBuf::from));
        }
        let set: Vec<Option<PathBuf>> = scene.objects.iter().map(|o| o.path.clone()).collect();
        if set != own {
            let listed = |paths: &[Option<PathBuf>]| {
                let paths: Vec<&PathBuf> = paths.iter().flatten().collect();
                format!("{paths:?}")
            };
            let (set, own) = (listed(&set), listed(&own));
            bail!(
                "--set gives the scene the objects {set}, and the file has {own}: what is arranged here is saved to the file, so \
                 write scene.objects there and leave it out of --set"
            );
        }
        Ok(())
    }

    fn object(&mut self, index: usize) -> anyhow::Result<&mut dyn TableLike> {
        let scene = self.table("scene")?;
        let found: Option<&mut dyn TableLike> = match scene.get_mut("objects") {
            Some(Item::ArrayOfTables(tables)) => tables.get_mut(index).map(|t| t as _),
            Some(Item::Value(Value::Array(array))) => array
                .get_mut(index)
                .and_then(Value::as_inline_table_mut)
                .map(|t| t as _),
            _ => None,
        };
        found.with_context(|| format!("there is no object {}", index.saturating_add(1)))
    }

    /// Whether the object stands at a `position` in metres, not at a pixel.
    ///
    /// # Errors
    /// If there is no such object.
    pub fn is_by_position(&mut self, index: usize) -> anyhow::Result<bool> {
        Ok(!self.object(index)?.contains_key("at_pixel"))
    }

    /// Whether a place is looked for where the object is free, seen and whole.
    ///
    /// # Errors
    /// If there is no such object.
    pub fn is_looked_for(&mut self, index: usize) -> anyhow::Result<bool> {
        Ok(self.object(index)?.contains_key("place"))
    }

    /// Puts an object at a pixel.
    ///
    /// # Errors
    /// If there is no such object.
    pub fn put_at_pixel(&mut self, index: usize, pixel: [f64; 2]) -> anyhow::Result<()> {
        let pixel = numbers(pixel.map(|x| rounded(x, 1)));
        set(self.object(index)?, "at_pixel", pixel);
        Ok(())
    }

    /// Puts an object at a point, metres.
    ///
    /// # Errors
    /// If there is no such object.
    pub fn put_at(&mut self, index: usize, point: DVec3) -> anyhow::Result<()> {
        let point = numbers(point.to_array().map(|x| rounded(x, 4)));
        let table = self.object(index)?;
        table.remove("place");
        table.remove("place_draw");
        set(table, "position", point);
        Ok(())
    }

    /// Turns and sizes an object.
    ///
    /// # Errors
    /// If there is no such object.
    pub fn shape(&mut self, index: usize, edit: &ObjectEdit) -> anyhow::Result<()> {
        let table = self.object(index)?;
        if let Some(yaw) = edit.yaw_deg {
            table.remove("to_pixel");
            set(table, "yaw_deg", rounded(yaw, 2));
        }
        if let Some(factor) = edit.size {
            let number = |v: &Item| v.as_float().or(v.as_integer().map(|i| i as f64));
            let (key, old) = match table.get("height_m").and_then(number) {
                Some(height) => ("height_m", height),
                None => ("scale", table.get("scale").and_then(number).unwrap_or(1.0)),
            };
            // Four digits, whatever the unit of the file.
            let new = old * factor;
            let digits = 3 - new.abs().max(1e-12).log10().floor() as i32;
            set(table, key, rounded(new, digits.clamp(0, 12)));
        }
        Ok(())
    }

    /// Says where the sun is, instead of a time or a shadow.
    ///
    /// # Errors
    /// If `[light]` is no table.
    pub fn sun(&mut self, sun: &SunEdit) -> anyhow::Result<()> {
        let light = self.table("light")?;
        light.remove("shadow");
        let empty = || value(Value::InlineTable(InlineTable::new()));
        let item = light.entry("sun").or_insert_with(empty);
        let table = item.as_table_like_mut().context("light.sun is no table")?;
        for key in ["time", "relative_to"] {
            table.remove(key);
        }
        set(table, "azimuth_deg", rounded(sun.azimuth_deg, 1));
        set(table, "elevation_deg", rounded(sun.elevation_deg, 1));
        if let Some(inline) = item.as_inline_table_mut() {
            inline.fmt();
        }
        Ok(())
    }

    /// Draws a shadow, instead of a direction of the sun.
    ///
    /// # Errors
    /// If `[light]` is no table.
    pub fn shadow(&mut self, shadow: &ShadowEdit) -> anyhow::Result<()> {
        let light = self.table("light")?;
        if let Some(sun) = light.get_mut("sun").and_then(Item::as_table_like_mut) {
            for key in ["time", "azimuth_deg", "elevation_deg", "relative_to"] {
                sun.remove(key);
            }
            if sun.is_empty() {
                light.remove("sun");
            }
        }
        let mut table = InlineTable::new();
        let pixel = |p: [f64; 2]| numbers(p.map(|x| rounded(x, 1)));
        table.insert("foot", pixel(shadow.foot));
        table.insert("tip", pixel(shadow.tip));
        if let Some(height) = shadow.height_m {
            table.insert("height_m", rounded(height, 3).into());
        }
        set(light, "shadow", table);
        Ok(())
    }

    /// Exposes the light.
    ///
    /// # Errors
    /// If `[composite]` is no table.
    pub fn exposure(&mut self, stops: f64) -> anyhow::Result<()> {
        set(self.table("composite")?, "exposure_ev", rounded(stops, 2));
        Ok(())
    }

    /// Names the mask.
    ///
    /// # Errors
    /// If `[scene]` is no table.
    pub fn occluders(&mut self, name: &str) -> anyhow::Result<()> {
        set(self.table("scene")?, "occluders", name);
        Ok(())
    }

    /// All of `edit` but camera and places, which want a camera.
    ///
    /// # Errors
    /// Where the text has no such tables.
    pub fn apply_light(&mut self, edit: &Edit) -> anyhow::Result<()> {
        if let Some(sun) = &edit.sun {
            self.sun(sun)?;
        }
        if let Some(shadow) = &edit.shadow {
            self.shadow(shadow)?;
        }
        if let Some(stops) = edit.exposure_ev {
            self.exposure(stops)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use dipir_scene::camera::FieldOfView;
    use glam::Vec3;

    use super::*;

    const TEXT: &str = "# Mine.\n[scene]\nbackground = \"a.png\" # the street\n\n\
        [[scene.objects]]\npath = \"b.glb\"\n# here\nat_pixel = [1, 2] # on the kerb\nheight_m = 2\n\n\
        [scene.camera] # guessed\nfov_deg = 40.0 # vertical\npitch_deg = 0.0\n";

    #[test]
    fn comments_and_order_stay() {
        let mut document = Document::parse(TEXT).unwrap();
        document.put_at_pixel(0, [640.04, 480.0]).unwrap();
        let edit = ObjectEdit {
            yaw_deg: Some(-0.001),
            size: Some(0.5),
            ..ObjectEdit::default()
        };
        document.shape(0, &edit).unwrap();
        let expected = TEXT
            .replace("[1, 2] #", "[640.0, 480.0] #")
            .replace("height_m = 2\n", "height_m = 1.0\nyaw_deg = 0.0\n");
        assert_eq!(document.text(), expected);
    }

    #[test]
    fn a_copy_follows_its_original_and_an_object_that_is_left_out_is_gone() {
        let mut document = Document::parse(TEXT).unwrap();
        let of = |of| ObjectEdit {
            of,
            ..ObjectEdit::default()
        };
        document.order_objects(&[of(0), of(0)]).unwrap();
        document.put_at_pixel(1, [7.0, 8.0]).unwrap();
        let text = document.text();
        assert_eq!(text.matches("[[scene.objects]]").count(), 2);
        let camera = text.find("[scene.camera]").unwrap();
        assert!(text.find("[7.0, 8.0]").unwrap() < camera, "{text}");
        document.order_objects(&[of(1)]).unwrap();
        assert!(!document.text().contains("[1, 2]"));
        for none in [3, usize::MAX] {
            document.order_objects(&[of(none)]).unwrap_err();
        }
        document.order_objects(&[]).unwrap_err();
    }

    #[test]
    fn comments_of_a_list_go_with_their_objects() {
        let list = |lines: &str| {
            format!("[scene]\nobjects = [ # all\n{lines}  # end\n] # done\nclass = \"b\"\n")
        };
        let [a, b] = [
            "  # first\n  { path = \"a.glb\" }, # one\n",
            "  # second\n  { path = \"b.glb\" }, # two\n",
        ];
        let ordered = |lines: &str, order: &[usize]| {
            let mut document = Document::parse(&list(lines)).unwrap();
            let of = |of: &usize| ObjectEdit {
                of: *of,
                ..ObjectEdit::default()
            };
            let order: Vec<_> = order.iter().map(of).collect();
            document.order_objects(&order).map(|()| document.text())
        };
        for (order, expected) in [
            (vec![1, 0], [b, a].concat()),
            (vec![0], a.into()),
            (vec![1], b.into()),
            (vec![0, 0, 1], [a, a, b].concat()),
        ] {
            let text = ordered(&[a, b].concat(), &order).unwrap();
            assert_eq!(text, list(&expected), "{order:?}");
        }
        // Two in a line: the comment of one does not swallow the next.
        let text = ordered("  {}, # one\n  {}, { path = \"c.glb\" },\n", &[0, 2]).unwrap();
        assert!(
            text.parse::<DocumentMut>().is_ok() && text.contains("\n { path = \"c.glb\" }"),
            "{text}"
        );
        ordered(a, &[0, 1]).unwrap_err();
    }

    #[test]
    fn lines_end_as_they_did() {
        let text = TEXT.replace('\n', "\r\n");
        let mut document = Document::parse(&text).unwrap();
        assert_eq!(document.text(), text);
        document.exposure(0.5).unwrap();
        let added = "\r\n[composite]\r\nexposure_ev = 0.5\r\n";
        assert_eq!(document.text(), text + added);
    }

    #[test]
    fn a_camera_of_another_file_is_not_changed() {
        let look = Vec3::ZERO;
        let view = FieldOfView::Vertical(0.7);
        let camera = Camera::look_at(Vec3::new(0.0, 1.6, 2.0), look, Vec3::Y, view, [12, 8]);
        let turn = Turn {
            pitch_deg: -3.0,
            roll_deg: 0.0,
            fov_deg: 40.0,
        };
        let text = "[scene.camera]\nfile = \"track.chan\"\n";
        let mut document = Document::parse(text).unwrap();
        for error in [
            document.turn(&turn, Some(40.0), &camera).unwrap_err(),
            document.shift_camera(&camera, DVec3::Y).unwrap_err(),
        ] {
            assert!(error.to_string().contains("scene.camera.file"), "{error}");
        }
        assert_eq!(document.text(), text);
        // A file that tells a lens alone has the position beside it.
        let lens = format!("{text}position = [0.0, 1.6, 2.0]\n");
        let mut document = Document::parse(&lens).unwrap();
        document.shift_camera(&camera, DVec3::Y).unwrap();
        assert!(document.text().contains("position = [0.0, 2.6, 2.0]"));
        document.turn(&turn, Some(40.0), &camera).unwrap_err();
        document.turn(&turn, None, &camera).unwrap();
        let text = document.text();
        assert!(
            text.contains("pitch_deg = -3.0") && !text.contains("fov_deg"),
            "{text}"
        );
    }

    #[test]
    fn a_drawn_shadow_replaces_the_sun_and_the_sun_a_shadow() {
        let text = "[light]\nsun = { azimuth_deg = 1.0, share = 0.5 }\n";
        let mut document = Document::parse(text).unwrap();
        let shadow = ShadowEdit {
            foot: [1.0, 2.0],
            tip: [3.0, 4.0],
            height_m: None,
        };
        document.shadow(&shadow).unwrap();
        let with_shadow = document.text();
        assert!(with_shadow.contains("share = 0.5") && !with_shadow.contains("azimuth"));
        assert!(with_shadow.contains("foot = [1.0, 2.0]"), "{with_shadow}");
        let sun = SunEdit {
            azimuth_deg: 90.0,
            elevation_deg: 30.0,
        };
        document.sun(&sun).unwrap();
        let with_sun = document.text();
        assert!(!with_sun.contains("shadow") && with_sun.contains("azimuth_deg = 90.0"));
    }
}
