//! Which kinds of surface a scene has, found from its materials without decoding a texture.
use serde::{Deserialize, Serialize};

use crate::material::{AlphaMode, Material};
use crate::scene::Scene;

/// What a render may have to simulate. A feature that is false here is on no surface.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SceneFeatures {
    /// Textures other than normal maps.
    pub textures: bool,
    /// Vertex colours.
    pub vertex_colors: bool,
    /// Normal maps, the coat's included.
    pub normal_maps: bool,
    /// Masked coverage below the cutoff is possible.
    pub alpha_mask: bool,
    /// Blended coverage below 1 is possible.
    pub alpha_blend: bool,
    /// Emission above zero.
    pub emission: bool,
    /// A coat.
    pub clearcoat: bool,
    /// Transmission.
    pub transmission: bool,
    /// A mirror-like lobe: metal, or a dielectric interface whose index is not 1.
    pub specular: bool,
    /// Surfaces that ignore light.
    pub unlit: bool,
    /// Surfaces whose back is not drawn.
    pub single_sided: bool,
}

impl SceneFeatures {
    /// Of the materials that triangles use.
    pub fn of(scene: &Scene) -> Self {
        let mut used = vec![false; scene.materials.len()];
        for &m in &scene.mesh.materials {
            used[m as usize] = true;
        }
        let colors = &scene.mesh.colors;
        let translucent_colors = colors.iter().any(|c| c.w < 1.0);
        let mut all = Self {
            vertex_colors: !colors.is_empty(),
            ..Self::default()
        };
        for (material, _) in scene.materials.iter().zip(used).filter(|(_, used)| *used) {
            all.add(material, translucent_colors);
        }
        all
    }

    fn add(&mut self, m: &Material, translucent_colors: bool) {
        let coat = m.clearcoat.as_ref();
        let coat_normal = coat.and_then(|c| c.normal_texture);
        let normals = usize::from(m.normal_texture.is_some()) + usize::from(coat_normal.is_some());
        let varies = m.base_color_texture.is_some() || translucent_colors;
        self.normal_maps |= normals > 0;
        self.textures |= m.texture_refs().count() > normals;
        match m.alpha_mode {
            AlphaMode::Opaque => {}
            AlphaMode::Mask { cutoff } => self.alpha_mask |= varies || m.base_color.w < cutoff,
            AlphaMode::Blend => self.alpha_blend |= varies || m.base_color.w < 1.0,
        }
        self.emission |= m.emissive != glam::Vec3::ZERO;
        self.unlit |= m.unlit;
        self.single_sided |= !m.double_sided;
        if m.unlit {
            return;
        }
        self.clearcoat |= coat.is_some_and(|c| c.factor > 0.0);
        self.transmission |= m.transmission.is_some_and(|t| t.factor > 0.0);
        self.specular |= m.metallic > 0.0 || m.ior != 1.0;
    }
}
