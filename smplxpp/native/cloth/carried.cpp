// What particles carry: fine vertices in the frames of coarse triangles, kept out of the skin, and the way of vertices between
// the T-pose and the pose. One thread, float, built without contraction: the same bits everywhere.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "cloth/surface.hpp"
#include "cloth/vec3.hpp"
#include "common/status.hpp"

namespace {

using smplxpp::check_indices;
using smplxpp::Contact;
using smplxpp::Surface;
using smplxpp::Vec3;

// N vertices in the frames of t triangles of n particles with m faces, a collider of c vertices and d faces, and e edges between
// the vertices. smplxpp/cloth/embedding.py says the same.
struct Carried {
    int64_t vertices, triangles, particles, faces, collider_vertices, collider_faces, edges;
    const int32_t* triangle;       // 3 t: particles
    const int32_t* which;          // N: the triangle that carries each
    const float* weight;           // 3 N: barycentric
    const float* offset;           // 3 N: metres along the first edge, the second direction, the smooth normal
    const int32_t* face;           // 3 m
    const int32_t* collider_face;  // 3 d
    const float* deepest;          // c: metres; deeper cloth is on the other side
    const int32_t* edge;           // 2 e
    const float* most;             // e: metres that it may be long
};

// Skinning weights of V vertices over J joints, and the R of them that are meant. smplxpp/cloth/embedding.py says the same.
struct Skinned {
    int64_t rows, vertices, joints, influences;
    const int32_t* row;    // R
    const int32_t* joint;  // (V, influences)
    const float* weight;   // (V, influences)
};

constexpr float kDrawnOut = 0.015f;  // metres inside from which drawn cloth is not brought out wholly

Vec3 unit(Vec3 a) { return a * (1.0f / std::max(smplxpp::length(a), 1e-12f)); }

// To `margin` metres before the surface, along its smooth normal, where a place lies behind that and not too deep; `whole`
// metres deep and more by less and less, to nothing at twice that: neighbours of which one alone came out would be a spike.
Vec3 pushed_out(Vec3 p, Vec3 cloth_normal, Surface& surface, const int32_t* faces, const Vec3* skin, float margin,
                const float* deepest, float whole) {
    const int32_t near = surface.nearest(p, cloth_normal);
    if (near < 0 || surface.clear(p, near)) return p;
    const Contact contact = surface.find_from(near, p, cloth_normal);
    if (contact.face < 0) return p;
    const int32_t* q = faces + 3 * int64_t(contact.face);
    Vec3 foot = {0, 0, 0}, normal = {0, 0, 0};
    float most = 0;
    for (int j = 0; j < 3; ++j) {
        foot = foot + skin[q[j]] * contact.weight[j];
        normal = normal + surface.normal(q[j]) * contact.weight[j];
        most += deepest[q[j]] * contact.weight[j];
    }
    const float l = smplxpp::length(normal);
    if (l < 1e-6f) return p;
    normal = normal * (1.0f / l);
    const float height = dot(p - foot, normal);
    if (!(height < margin && height > -most)) return p;
    return p + normal * ((margin - height) * std::clamp(2.0f + height / whole, 0.0f, 1.0f));
}

constexpr int kSweeps = 12;  // over the drawn edges that are too long

// Draws the ends of edges that are too long together, sweep after sweep until none is; marks what was moved. Frames of triangles
// that turn against each other draw what lies off them apart.
bool drawn_together(const Carried& in, Vec3* points, std::vector<uint8_t>& moved) {
    bool any = false, within = false;
    for (int sweep = 0; sweep < kSweeps && !within; ++sweep) {
        within = true;
        for (int64_t k = 0; k < in.edges; ++k) {
            const int64_t e = sweep % 2 ? in.edges - 1 - k : k;
            const int32_t i = in.edge[2 * e], j = in.edge[2 * e + 1];
            const Vec3 d = points[i] - points[j];
            const float squared = dot(d, d), most = in.most[e];
            if (!(squared > most * most)) continue;
            const float l = std::sqrt(squared);
            const Vec3 step = d * (0.5f * (l - most) / l);
            points[i] = points[i] - step, points[j] = points[j] + step;
            moved[size_t(i)] = moved[size_t(j)] = 1;
            within = false, any = true;
        }
    }
    return any;
}

// Metres between the places of a drawn edge that are kept out of the skin: round skin of 3 cm radius is 2 mm before the middle of
// such a chord, which is how far drawn vertices are kept out (drawn_margin of smplxpp/cloth/driver.py).
constexpr float kSampled = 0.02f;

// Brings long edges out of the skin that their ends are out of. A place at t that goes out by d takes the ends along, by
// d (1 - t) / ((1 - t)^2 + t^2) and d t / ((1 - t)^2 + t^2), the least that does it.
template <class Out>
void edges_out(const Carried& in, Vec3* points, const std::vector<Vec3>& up, Out&& out) {
    for (int64_t e = 0; e < in.edges; ++e) {
        const int32_t i = in.edge[2 * e], j = in.edge[2 * e + 1];
        const float length = smplxpp::length(points[i] - points[j]);
        if (!(length > kSampled)) continue;  // nor one without a value
        const int32_t parts = int32_t(std::min(length / kSampled, 8.0f)) + 1;
        for (int32_t k = 1; k < parts; ++k) {
            const float t = float(k) / float(parts), s = 1.0f - t;
            const Vec3 place = points[i] * s + points[j] * t;
            const Vec3 step = (out(place, unit(up[size_t(i)] * s + up[size_t(j)] * t)) - place) * (1.0f / (s * s + t * t));
            points[i] = points[i] + step * s, points[j] = points[j] + step * t;
        }
    }
}

// The transform of a vertex: its joints' (J, 3, 4), blended.
void blend(const Skinned& in, const float* transforms, int64_t vertex, float* __restrict m) {
    float sum[12] = {};
    for (int64_t k = vertex * in.influences; k < (vertex + 1) * in.influences; ++k) {
        const float w = in.weight[k];
        if (uint32_t(in.joint[k]) >= uint32_t(in.joints)) smplxpp::throw_out_of_range("joint");
        const float* __restrict t = transforms + 12 * int64_t(in.joint[k]);
        for (int i = 0; i < 12; ++i) sum[i] += w * t[i];
    }
    std::copy(sum, sum + 12, m);
}

}  // namespace

// points (3 N): where particles at x (3 n) take what they carry, `margin` metres out of the collider at `skin` (3 c).
SMPLXPP_EXPORT int32_t smplxpp_cloth_carry(const Carried* in, const float* x, const float* skin, float margin, float* points) {
    return smplxpp::guarded([&] {
        check_indices(in->triangle, 3 * in->triangles, in->particles);
        check_indices(in->which, in->vertices, in->triangles);
        check_indices(in->face, 3 * in->faces, in->particles);
        check_indices(in->collider_face, 3 * in->collider_faces, in->collider_vertices);
        check_indices(in->edge, 2 * in->edges, in->vertices);
        const Vec3* place = (const Vec3*)x;
        std::vector<Vec3> normal(size_t(in->particles)), tangent(2 * size_t(in->triangles));
        smplxpp::normals(place, in->face, in->faces, normal);
        for (int64_t t = 0; t < in->triangles; ++t) {
            const int32_t* q = in->triangle + 3 * t;
            const Vec3 edge = place[q[1]] - place[q[0]];
            const Vec3 across = unit(cross(edge, place[q[2]] - place[q[0]]));
            tangent[size_t(2 * t)] = unit(edge);
            tangent[size_t(2 * t + 1)] = cross(across, tangent[size_t(2 * t)]);
        }
        Surface surface(in->collider_vertices, in->collider_face, in->collider_faces);
        surface.look((const Vec3*)skin);
        std::vector<Vec3> up(size_t(in->vertices));
        const auto out = [&](Vec3 p, Vec3 normal) {
            return pushed_out(p, normal, surface, in->collider_face, (const Vec3*)skin, margin, in->deepest, kDrawnOut);
        };
        for (int64_t v = 0; v < in->vertices; ++v) {
            const int64_t t = in->which[v];
            const int32_t* q = in->triangle + 3 * t;
            const float *w = in->weight + 3 * v, *by = in->offset + 3 * v;
            const Vec3 there = place[q[0]] * w[0] + place[q[1]] * w[1] + place[q[2]] * w[2] + tangent[size_t(2 * t)] * by[0] +
                               tangent[size_t(2 * t + 1)] * by[1];
            up[size_t(v)] = unit(normal[size_t(q[0])] * w[0] + normal[size_t(q[1])] * w[1] + normal[size_t(q[2])] * w[2]);
            ((Vec3*)points)[v] = out(there + up[size_t(v)] * by[2], up[size_t(v)]);
        }
        edges_out(*in, (Vec3*)points, up, out);
        // What was drawn together may lie in the skin then; the lengths have the last word.
        std::vector<uint8_t> moved(size_t(in->vertices), 0);
        if (!drawn_together(*in, (Vec3*)points, moved)) return;
        for (size_t v = 0; v < moved.size(); ++v)
            if (moved[v]) ((Vec3*)points)[v] = out(((Vec3*)points)[v], up[v]);
        drawn_together(*in, (Vec3*)points, moved);
    });
}

// Moves n points (3 n metres, in place) with outward normals to `margin` metres outside a surface of c vertices and d faces,
// where they lie less than `deepest` metres behind it.
SMPLXPP_EXPORT int32_t smplxpp_cloth_push_out(int64_t n, float* points, const float* normals, int64_t c, const float* vertices,
                                              const int32_t* faces, int64_t d, float margin, const float* deepest) {
    return smplxpp::guarded([&] {
        check_indices(faces, 3 * d, c);
        Surface surface(c, faces, d);
        const Vec3* skin = (const Vec3*)vertices;
        surface.look(skin);
        for (int64_t i = 0; i < n; ++i) {
            Vec3& p = ((Vec3*)points)[i];
            p = pushed_out(p, ((const Vec3*)normals)[i], surface, faces, skin, margin, deepest, INFINITY);
        }
    });
}

// places (3 R): where transforms (J, 3, 4) take rest (3 V).
SMPLXPP_EXPORT int32_t smplxpp_cloth_posed(const Skinned* in, const float* transforms, const float* rest, float* places) {
    return smplxpp::guarded([&] {
        check_indices(in->row, in->rows, in->vertices);
        for (int64_t r = 0; r < in->rows; ++r) {
            float m[12];
            blend(*in, transforms, in->row[r], m);
            const float* p = rest + 3 * int64_t(in->row[r]);
            for (int k = 0; k < 3; ++k)
                places[3 * r + k] = m[4 * k] * p[0] + m[4 * k + 1] * p[1] + m[4 * k + 2] * p[2] + m[4 * k + 3];
        }
    });
}

// displacements (3 R) from rest (3 V), along the axes of the T-pose, that skinning takes to places (3 R). Joints that turn
// against each other flatten a blend; where its determinant is not above `least` there is none.
SMPLXPP_EXPORT int32_t smplxpp_cloth_unposed(const Skinned* in, const float* transforms, const float* rest, const float* places,
                                             float least, float* displacements) {
    return smplxpp::guarded([&] {
        check_indices(in->row, in->rows, in->vertices);
        for (int64_t r = 0; r < in->rows; ++r) {
            float m[12];
            blend(*in, transforms, in->row[r], m);
            const Vec3 a = {m[0], m[4], m[8]}, b = {m[1], m[5], m[9]}, c = {m[2], m[6], m[10]};
            const Vec3 p = ((const Vec3*)places)[r] - Vec3{m[3], m[7], m[11]};
            const Vec3 bc = cross(b, c), ca = cross(c, a), ab = cross(a, b);  // Cramer's rule
            const float volume = dot(a, bc);
            const float over = 1.0f / volume;
            const Vec3 from = ((const Vec3*)rest)[in->row[r]], back = Vec3{dot(p, bc), dot(p, ca), dot(p, ab)} * over;
            ((Vec3*)displacements)[r] = volume > least ? back - from : Vec3{0, 0, 0};
        }
    });
}
