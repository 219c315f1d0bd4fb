//! How extensions of the metallic-roughness model change the base's interface: the reflectance of
//! the dielectric (`KHR_materials_specular`), a thin film (`KHR_materials_iridescence`) and facets that
//! spread more in one direction (`KHR_materials_anisotropy`).
//!
//! Where reflectance has a colour or a film, what lies below receives what its largest channel
//! leaves over: light is lost, never gained. An anisotropic lobe is an isotropic one, stretched along
//! the tangent [Heitz 2014, section 5.3]. Of what its single scattering loses it gets back what the isotropic
//! lobe that is as wide as it is across the tangent loses, which is less.
use glam::Vec3;

use super::fresnel::f0_from_ior;
use super::ggx::Ggx;
use super::thin_film::Film;
use crate::surface::SurfacePoint;

/// The interface of a base with extensions.
#[derive(Clone, Copy, Debug)]
pub(super) struct Interface {
    /// Perceptual roughness across the tangent.
    pub roughness: f32,
    /// How much wider the lobe is along the tangent than across it.
    pub stretch: f32,
    /// Reflectance at normal incidence, dielectric and metal mixed, without the film.
    f0: Vec3,
    /// Reflectance at grazing incidence, mixed alike.
    pub f90: Vec3,
    /// Reflectance at normal incidence that stands for the film where energy is shared out.
    pub f0_bound: Vec3,
    /// The largest channel of that of the dielectric, and its reflectance at grazing incidence.
    pub dielectric: (f32, f32),
    film: Option<Film>,
}

impl Interface {
    /// Without extensions.
    pub const PLAIN: Self = Self {
        roughness: 1.0,
        stretch: 1.0,
        f0: Vec3::ZERO,
        f90: Vec3::ONE,
        f0_bound: Vec3::ZERO,
        dielectric: (0.0, 1.0),
        film: None,
    };

    /// Of a `surface` whose base reflects.
    pub fn new(surface: &SurfacePoint) -> Self {
        let extension = &surface.extension;
        let of_dielectric = (f0_from_ior(surface.ior) * extension.specular_color).min(Vec3::ONE)
            * extension.specular;
        let f0 = of_dielectric.lerp(surface.base_color, surface.metallic);
        let film = Film::new(&extension.film, f0);
        let (f0_bound, dielectric) = match &film {
            Some(film) => {
                let bound = f0.lerp(film.bound(), film.factor);
                (bound, bound.max_element())
            }
            None => (f0, of_dielectric.max_element()),
        };
        // At grazing incidence a film reflects all, however weak the dielectric's own reflection is.
        let film_factor = film.as_ref().map_or(0.0, |film| film.factor);
        let grazing = extension.specular + (1.0 - extension.specular) * film_factor;
        let mut interface = Self {
            f0,
            f90: Vec3::splat(extension.specular).lerp(Vec3::ONE, surface.metallic),
            f0_bound,
            dielectric: (dielectric, grazing.max(dielectric)),
            film,
            roughness: surface.roughness,
            ..Self::PLAIN
        };
        if extension.anisotropy > 0.0 {
            interface.roughness = surface.roughness.max(Ggx::MIN_ROUGHNESS);
            let across = interface.roughness * interface.roughness;
            let along = across + (1.0 - across) * extension.anisotropy * extension.anisotropy;
            interface.stretch = along / across;
        }
        interface
    }

    /// Reflectance of a facet at Schlick's `weight` for its `cosine`.
    #[inline]
    pub fn fresnel(&self, weight: f32, cosine: f32) -> Vec3 {
        let plain = self.f0 + (self.f90 - self.f0) * weight;
        match &self.film {
            Some(film) => plain.lerp(film.reflectance(cosine), film.factor),
            None => plain,
        }
    }

    /// Whether there is a film.
    #[inline]
    pub fn has_film(&self) -> bool {
        self.film.is_some()
    }

    /// The largest channel of [`fresnel`](Self::fresnel) where there is a film, else 0.
    #[inline]
    pub fn below_film(&self, weight: f32, cosine: f32) -> f32 {
        match self.film {
            Some(_) => self.fresnel(weight, cosine).max_element().min(1.0),
            None => 0.0,
        }
    }

    /// A direction in the space in which the lobe is isotropic.
    #[inline]
    pub fn stretched(&self, w: Vec3) -> Vec3 {
        Vec3::new(w.x * self.stretch, w.y, w.z)
    }

    /// Density of the unit normal `h`, where the isotropic lobe is `ggx`.
    #[inline]
    pub fn d(&self, ggx: &Ggx, h: Vec3) -> f32 {
        ggx.d(Vec3::new(h.x / self.stretch, h.y, h.z)) / self.stretch
    }
}
